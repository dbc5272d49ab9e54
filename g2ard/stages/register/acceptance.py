"""Acceptance of an estimated pose: registered, uncertain or refused."""

from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.report import PoseError, Status


def acceptance(
    zncc: float, sigma: PoseError | None, depth: float, config: RegisterConfig
) -> tuple[Status, str | None]:
    """Return the status of a pose and the reason, None if it is registered.

    Args:
        zncc: median local ZNCC of photo and render.
        sigma: standard deviations of the pose; None if the photo does not determine it.
        depth: median depth of the render, scene units.
    """
    if sigma is None:
        return "refused", "the photo does not determine the pose"
    if zncc < min(config.doubt, config.accept):
        return "refused", f"the best render looks unlike it (ZNCC {zncc:.2f})"
    if zncc < config.accept:
        return "uncertain", f"the best render looks unlike it (ZNCC {zncc:.2f})"
    if sigma.rotation > config.max_angle_sigma:
        return "uncertain", f"the rotation is only known to {sigma.rotation:.2g}°"
    if sigma.position > config.max_position_sigma * depth:
        return "uncertain", f"the position is only known to {sigma.position / depth:.2g} of the depth"
    return "registered", None
