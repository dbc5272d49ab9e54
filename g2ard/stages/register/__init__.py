"""Registration of photos: estimating camera poses against a scene."""

from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.photos import register
from g2ard.stages.register.pose import pose_error
from g2ard.stages.register.report import PhotoReport, PoseError, Registered, RegisterReport

__all__ = [
    "PhotoReport",
    "PoseError",
    "RegisterConfig",
    "RegisterReport",
    "Registered",
    "pose_error",
    "register",
]
