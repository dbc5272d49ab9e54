//! Simplification: shared parts (moments, residual flags, guards, trim) and the policies over them.
