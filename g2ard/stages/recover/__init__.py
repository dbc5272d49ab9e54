"""Recovery: optimisation of a fixed set of Gaussians against photos or a teacher's renders."""

from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.optimize import Recovered, recover

__all__ = ["RecoverConfig", "Recovered", "recover"]
