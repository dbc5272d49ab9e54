//! Small dense linear algebra in f64: symmetric 3×3 eigen, quaternions, least squares.
