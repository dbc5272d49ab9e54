"""Renderer, numpy in, numpy out; and panoramas resampled from renders of the faces of a cube."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Bytes, Float, Float32, Values
from g2ard.config.checks import AboveZero, Within, checks_arguments
from g2ard.config.choices import BLACK, Convention
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require
from g2ard.io import read_splats
from g2ard.io.images import png_bytes, resize, to_bytes
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.lenses import FACES, panorama_rays, photo_of, pinhole_matrix
from g2ard.scene.prepared import DRAWN_LOG_SCALES, DRAWN_LOGITS, MAX_OPACITY
from g2ard.scene.splats import HasSplats, Splats, scene_of, unit_quats

Corners = tuple[list[float], list[float]]
View = tuple[list[list[float]], list[float], tuple[int, int], float]


@dataclass(frozen=True)
class RasterSettings(Settings):
    """Conventions of the rasteriser.

    Args:
        convention: "gsplat" (default, used by current trainers) or "inria" (also limits each splat to the
            tiles that its 3σ square touches).
        antialiased: opacity × √(det Σ₂ / det(Σ₂ + 0.3 I)), Mip-Splatting's factor; None means as the scene's
            `render_model` says.
        alpha_max: upper limit of α: 0.99 as in 3DGS; some trainers use 0.999.
        near: near plane, scene units; None means the convention's 0.01 (gsplat) or 0.2 (inria), and less in a
            small scene (`settings_for`). A sequence holds one distance per camera.

    Raises:
        InputError: a value out of range.

    >>> RasterSettings(convention="inria").near_of(0)
    0.2
    """

    convention: Convention = "gsplat"
    antialiased: bool | None = None
    alpha_max: Annotated[float, Within(f"[{1 / 255}, 1)")] = MAX_OPACITY
    near: AboveZero | Sequence[float] | None = None

    def near_of(self, index: int) -> float:
        """Return the near plane of camera `index`."""
        if self.near is None:
            return 0.01 if self.convention == "gsplat" else 0.2
        if isinstance(self.near, (int, float)):
            return float(self.near)
        return float(self.near[index])


def settings_for(
    means: Values, settings: RasterSettings | None = None, *, antialiased: bool = False
) -> RasterSettings:
    """Fill in what settings leave to the scene: its render model, and a near plane for its unit.

    The conventions' near planes suit scenes a few units across. If half of the Gaussians lie within r < ½ of
    the median, the near plane is 2r times the convention's.

    Args:
        means: (N, 3) scene units.
        settings: None means gsplat's convention. A given near plane is kept.
        antialiased: the scene's render model, unless the settings say.

    >>> import numpy as np
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> settings_for(corners).near_of(0), round(settings_for(corners / 1024).near_of(0), 9)
    (0.01, 1.6915e-05)
    """
    settings = settings or RasterSettings()
    if settings.antialiased is None:
        settings = replace(settings, antialiased=antialiased)
    if settings.near is not None or not len(means):
        return settings
    stride = -(-len(means) // _NEAR_SAMPLE)
    sample = means[::stride].astype(np.float64)
    sample -= np.median(sample, axis=0)
    radius = float(np.median(np.linalg.norm(sample, axis=1)))
    near = settings.near_of(0) * min(1.0, 2 * radius or 1.0)
    return replace(settings, near=near)


def view_of(cameras: Cameras, index: int, settings: RasterSettings) -> View:
    """Convert one camera to the form that `_core` takes."""
    (fx, _, cx), (_, fy, cy), _ = cameras.Ks[index].tolist()
    return (
        cameras.viewmats[index].tolist(),
        [fx, fy, cx, cy],
        (int(cameras.widths[index]), int(cameras.heights[index])),
        settings.near_of(index),
    )


def corners_of(box: Float) -> Corners:
    """Convert a (2, 3) box to the form that `_core` takes."""
    low, high = np.asarray(box, np.float64).tolist()
    return low, high


def arrays_of(splats: Splats) -> tuple[Float32, Float32, Float32, Float32, Float32, Float32]:
    """Return the six float32 arrays that `_core` takes, in stored form.

    Logits and log-scales are clamped to what float32 can represent: a byte opacity of 255 decodes to +∞.
    Quaternions are normalised, since the squares of long and short ones overflow or vanish.
    """
    with np.errstate(divide="ignore"):
        log_scales = np.clip(splats.log_scales, *DRAWN_LOG_SCALES)
    logits = np.clip(splats.logit_opacities, *DRAWN_LOGITS)
    arrays = (
        splats.means,
        unit_quats(splats.quats),
        log_scales,
        logits,
        splats.sh0,
        splats.shN,
    )
    a, b, c, d, e, f = (np.ascontiguousarray(array, dtype=np.float32) for array in arrays)
    return a, b, c, d, e, f


def centred(splats: Splats, cameras: Cameras) -> tuple[Splats, Cameras]:
    """Return the scene `narrowed`, and the cameras relative to its offset."""
    splats = splats.narrowed()
    return splats, cameras.recentred(splats.offset)


@dataclass(frozen=True, eq=False)
class Rendered:
    """Images of one rendered view.

    Args:
        image: (H, W, 3) float32, linear in the SH colours, ≥ 0, not clipped at 1.
        alpha: (H, W) float32 in [0, 1], the share of the background that is hidden.
        depth: (H, W) float32, scene units, Σ αT·z: alpha times the expected depth; divide by alpha for the
            depth.
        median: (H, W) float32, scene units, depth of the splat behind which less than half the light remains,
            0 if there is none; None unless requested.
    """

    image: Float32
    alpha: Float32
    depth: Float32
    median: Float32 | None = None

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"Rendered({width} × {height})"

    def image_8bit(self) -> Bytes:
        """Return the image as bytes, (H, W, 3) uint8, clipped and rounded like `g2ard render` does."""
        return to_bytes(self.image)

    def _repr_png_(self) -> bytes:
        return png_bytes(self.image)


class Renderer:
    """Renderer for many views of one scene; prepares the scene once and reuses buffers.

    A view skips 256 rows at a time that it cannot see, so scenes ordered in space render faster.

    Several threads may use one renderer: their calls take turns.

    Args:
        splats: the scene, SH degree 0–3.
        background: RGB in [0, 1] behind the scene.
        settings: conventions; None means gsplat's.

    Raises:
        InputError: the background is not three numbers from 0 to 1, or `settings.near` is a sequence.

    >>> from g2ard.scene.cameras import Camera
    >>> dot = Splats.create([[0, 0, 0]], scales=[[0.1] * 3], logit_opacities=[9])
    >>> front = Camera.facing([0, -2, 0], [0, 0, 0], width=32, height=24)
    >>> renderer = Renderer(dot, background=(1, 1, 1))
    >>> renderer.image(front).shape, round(float(renderer.render(front).depth[12, 16]))
    ((24, 32, 3), 2)
    """

    @checks_arguments
    def __init__(
        self,
        splats: Splats,
        *,
        background: Sequence[float] = BLACK,
        settings: RasterSettings | None = None,
    ) -> None:
        self.background = [float(c) for c in background]
        if settings is not None and not isinstance(settings.near, int | float | None):
            raise InputError("expected one distance for all views", parameter="near")
        splats = splats.narrowed()
        self._offset = splats.offset
        self._settings = settings_for(splats.means, settings, antialiased=splats.antialiased)
        self._arrays = arrays_of(splats)
        self._bounds = _core.RowBounds(self._arrays)
        self._rasterizer = _core.Rasterizer()

    def image(self, camera: Camera) -> Float32:
        """Render the (H, W, 3) image only, see `Rendered.image`; faster than `render`, and by gsplat's
        convention on the device in use (`system.devices`).

        Raises:
            InputError: an invalid camera, see `Cameras`.
        """
        view = self._view(camera)
        return self._rasterizer.image(
            self._arrays, view, self._settings, self.background, self._bounds
        )

    def clipped(self, camera: Camera) -> Float32:
        """Return `image` clipped to [0, 1], as photos are."""
        image = self.image(camera)
        return np.clip(image, 0, 1, out=image)

    def render(self, camera: Camera, *, median: bool = False) -> Rendered:
        """Render one view: C = Σᵢ cᵢ αᵢ Πⱼ<ᵢ (1 − αⱼ), front to back.

        Args:
            camera: the view, in world coordinates; its width and height are the image's.
            median: also return the median depth.

        Raises:
            InputError: an invalid camera, see `Cameras`.
        """
        view = self._view(camera)
        depths = 2 if median else 1
        image, alpha, depth, middle = self._rasterizer.forward(
            self._arrays, view, self._settings, self.background, depths, self._bounds
        )
        assert depth is not None
        return Rendered(image, alpha, depth, middle)

    def draw(
        self,
        camera: Camera,
        box: Float,
        color: Float32,
        light: Float32,
    ) -> None:
        """Draw a box of the scene on the planes of a `rendering.boxes.Canvas`, in place."""
        corners = corners_of(box - self._offset)
        view = self._view(camera)
        self._rasterizer.draw(
            self._arrays, view, self._settings, corners, (color, light), self._bounds
        )

    @checks_arguments
    def panorama(
        self, camera: Camera, *, width: Annotated[int, Within("[4, inf)")] = 2048
    ) -> Rendered:
        """Render an equirectangular panorama: all directions around a camera.

        Six pinhole renders, the faces of a cube at twice the resolution, are resampled.

        Args:
            camera: its pose, in world coordinates. Directions are those of nerfstudio's `EQUIRECTANGULAR`:
                the image's middle looks ahead, its right is right of that, and its top is up.
            width: pixels; the height is half of it.

        Returns:
            A `Rendered` whose depth is the distance from the camera.

        Raises:
            InputError: an invalid camera, or an odd width.

        >>> from g2ard.scene.cameras import Camera
        >>> dot = Splats.create([[0, 0, 0]], scales=[[0.1] * 3], logit_opacities=[9])
        >>> out = Renderer(dot).panorama(Camera.facing([0, -2, 0], [0, 0, 0]), width=64)
        >>> out.image.shape, bool(out.alpha[15:17, 31:33].min() > 0.2), float(out.alpha[0, 0])
        ((32, 64, 3), True, 0.0)
        """

        require("width", width, width % 2 == 0, "an even number of pixels")

        def shown(view: Camera) -> tuple[Float32, Float32, Float32]:
            rendered = self.render(view)
            return rendered.image, rendered.alpha, rendered.depth

        return Rendered(*panorama(shown, camera, width))

    def _view(self, camera: Camera) -> View:
        return view_of(Cameras.of([camera]).recentred(self._offset), 0, self._settings)


@checks_arguments
def render(
    splats: Splats | HasSplats | str | Path,
    camera: Camera,
    *,
    background: Sequence[float] = BLACK,
    settings: RasterSettings | None = None,
    median: bool = False,
) -> Rendered:
    """Render one view of a scene; for many views of one scene `Renderer` is faster.

    C = Σᵢ cᵢαᵢTᵢ + T·background from front to back, αᵢ = min(0.99, oᵢ·exp(−½dᵀΣ₂⁻¹d)), Tᵢ = Πⱼ(1 − αⱼ) over
    the splats in front; Σ₂ is the projected covariance with a dilation of 0.3 px² (3DGS, Kerbl et al. 2023).

    Args:
        splats: the scene, SH degree 0–3, a result, or the path of either.
        camera: the view, world coordinates.
        background: RGB in [0, 1] behind the scene.
        settings: conventions; None means gsplat's.
        median: also return the median depth.

    Returns:
        A `Rendered`: image (H, W, 3), alpha (H, W) and depth (H, W), all float32; depth in scene units.

    Raises:
        InputError: an unreadable scene, an invalid camera, or a background that is not three numbers from 0
            to 1.

    >>> from g2ard.scene.cameras import Camera
    >>> dot = Splats.create([[0, 0, 0]], scales=[[0.1] * 3], logit_opacities=[9])
    >>> out = render(dot, Camera.facing([0, -2, 0], [0, 0, 0], width=32, height=24), background=(1, 1, 1))
    >>> out.image.shape, bool(out.alpha[12, 16] > 0.9), out.image[0, 0].tolist()
    ((24, 32, 3), True, [1.0, 1.0, 1.0])
    """
    if isinstance(splats, str | Path):
        scene = read_splats(splats)
    else:
        scene = scene_of(splats)
    return Renderer(scene, background=background, settings=settings).render(camera, median=median)


_NEAR_SAMPLE = 65_536
"""Largest sample of Gaussians used to measure the size of a scene."""


_FINER = 2
"""Pixels of a face, and samples, along a side of a pixel in the panorama's middle."""
_MARGIN = 2
"""Pixels of a face beyond its edges, so that every sample lies between pixels."""
_BAND = 64
"""Rows of a panorama sampled together."""


def stations(cameras: Cameras) -> Cameras:
    """Return one view per photo: those that were resampled from one photo become a view in its axes.

    >>> [view.name for view in stations(Cameras.of([Camera.facing([0, -2, 0], [0, 0, 0])]))]
    ['view']
    """
    found: dict[str, Camera] = {}
    for view in cameras:
        if view.lens is None:
            found[view.name] = view
            continue
        name = photo_of(view.name)
        if name not in found:
            turn = np.array(view.lens.turn).reshape(3, 3)
            viewmat = np.eye(4)
            viewmat[:3] = turn @ view.viewmat[:3]
            found[name] = Camera(viewmat, view.K, view.width, view.height, name)
    return Cameras.of(found.values())


def panorama(
    shown: Callable[[Camera], tuple[Float32, Float32, Float32]], camera: Camera, width: int
) -> tuple[Float32, Float32, Float32]:
    """Render all directions around a camera.

    Args:
        shown: renders a pinhole view as image, alpha and depth.
        camera: its pose: the panorama's middle looks along z, its top is against y.
        width: pixels, even; the height is half of it.

    Returns:
        (H, W, 3) image, (H, W) alpha, and (H, W) alpha times the expected distance from the camera.
    """
    half = _FINER * width / (2 * np.pi)  # as many pixels per radian in the middle of a face
    side = 2 * (int(np.ceil(half)) + _MARGIN)
    middle = side / 2
    K = pinhole_matrix(half, half, middle, middle)
    v, u = np.mgrid[0:side, 0:side] + 0.5
    squares = (u - middle) ** 2 + (v - middle) ** 2
    reach = np.sqrt(squares / half**2 + 1).astype(np.float32)
    del v, u, squares
    pictures = []
    for turn in FACES.values():
        viewmat = np.eye(4)
        viewmat[:3] = turn.T @ camera.viewmat[:3]
        image, alpha, depth = shown(Camera(viewmat, K, side, side))
        planes = np.dstack([image, alpha, depth * reach])
        pictures.append(planes.reshape(side * side, 5))
    height = width // 2
    out = np.empty((height, width, 5), np.float32)
    for top in range(0, height, _BAND):
        bottom = min(top + _BAND, height)
        rows = slice(_FINER * top, _FINER * bottom)
        rays = panorama_rays(_FINER * width, _FINER * height, rows)
        fine = np.empty((len(rays), 5), np.float32)
        local = np.stack([rays @ turn for turn in FACES.values()])
        face = local[..., 2].argmax(axis=0)
        for number, picture in enumerate(pictures):
            here = np.flatnonzero(face == number)
            x, y, z = local[number, here].T
            fine[here] = _sample(
                picture,
                side,
                half * x / z + middle,
                half * y / z + middle,
            )
        fine_rows = fine.reshape(-1, _FINER * width, 5)
        out[top:bottom] = resize(fine_rows, (width, bottom - top))
    image = np.ascontiguousarray(out[..., :3])
    return image, out[..., 3].copy(), out[..., 4].copy()


def _sample(picture: Float32, side: int, u: Float, v: Float) -> Float32:
    """Sample a square picture, (side², C), bilinearly at pixels u, v."""
    u = u - 0.5
    v = v - 0.5
    left = np.floor(u).astype(int)
    above = np.floor(v).astype(int)
    right = (u - left)[:, None].astype(np.float32)
    down = (v - above)[:, None].astype(np.float32)
    at = above * side + left
    top = picture[at] * (1 - right)
    top += picture[at + 1] * right
    at += side
    bottom = picture[at] * (1 - right)
    bottom += picture[at + 1] * right
    return top * (1 - down) + bottom * down
