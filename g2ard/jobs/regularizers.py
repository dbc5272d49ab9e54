"""Regularisers of a recovery: given, named, or chosen by measuring the scene."""

from __future__ import annotations

from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import Regularizers
from g2ard.stages.recover.auto_preset import PriorMeasures, measure_prior, regularizers_for


def choose_regularizers(
    given: Regularizers | str | None, prior: Splats, cameras: Cameras | None = None, *, paper: bool = False
) -> tuple[Regularizers, str, PriorMeasures]:
    """Return the value of the setting `recover.regularizers`, why it is used, and the scene's measures.

    Args:
        given: weights, or a name, see `regularizers_for`; None means auto.
        prior: the scene of the anchors, before simplification if available.
        cameras: views for measuring consistency; None skips it.
        paper: use the weights of the paper for a name, for its schedule.

    Raises:
        InputError: an unknown name.
    """
    if isinstance(given, Regularizers):
        return given, "as given", measure_prior(prior, cameras)
    return regularizers_for(given or "auto", prior, cameras, paper=paper)
