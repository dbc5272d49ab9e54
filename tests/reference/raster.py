"""The rasteriser once more, naively: every pixel against every Gaussian, float64, differentiated by torch."""

from dataclasses import dataclass

import torch
from torch import Tensor

ALPHA_MIN = 1 / 255
STOP = 1e-4
DILATION = 0.3

C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154)


@dataclass
class Oracle:
    image: Tensor
    alpha: Tensor
    depth: Tensor
    median: Tensor
    weight: Tensor
    """(N, P) αT of every Gaussian in every pixel."""
    before: Tensor
    """(N, P) transmittance in front, where hit, else 0."""
    doubtful: Tensor
    """(P,) pixels where rounding may decide a skip, a clip, a stop or the order."""
    decisions: dict[str, Tensor]
    """Everything discrete: between two points where all of it is equal, the outputs are smooth."""


def sh_basis(d: Tensor, count: int) -> Tensor:
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    one = torch.ones_like(x)
    b = [0.28209479177387814 * one, -C1 * y, C1 * z, -C1 * x]
    b += [
        C2[0] * x * y,
        -C2[0] * y * z,
        C2[1] * (2 * zz - xx - yy),
        -C2[0] * x * z,
        C2[2] * (xx - yy),
    ]
    b += [-C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, -C3[2] * y * (4 * zz - xx - yy)]
    b += [C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -C3[2] * x * (4 * zz - xx - yy)]
    b += [C3[1] / 2 * z * (xx - yy), -C3[0] * x * (xx - 3 * yy)]
    return torch.stack(b[:count], -1)


def rotations(quats: Tensor) -> Tensor:
    norm = quats.norm(dim=-1, keepdim=True)
    unit = torch.where(norm > 0, quats, torch.tensor([1.0, 0, 0, 0], dtype=quats.dtype))
    w, x, y, z = (unit / torch.where(norm > 0, norm, torch.ones_like(norm))).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def render(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logit_opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    *,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near: float = 0.01,
    background: tuple[float, float, float] = (0, 0, 0),
    antialiased: bool = False,
    inria: bool = False,
    alpha_max: float = 0.99,
    clip_margin: float = 1e-4,
    box: tuple[Tensor, Tensor] | None = None,
    light: Tensor | None = None,
) -> Oracle:
    """All arguments float64. Returns flat pixels (P = H·W) in `Oracle.weight`, images otherwise.

    `box`: low and high corner. A pair counts if its pixel's ray is in it at the Gaussian's depth.
    `light`: (H, W) light in front of the scene or box; at most `STOP` where the pixel has stopped.
    `clip_margin`: how near, relatively, to `alpha_max` an α makes its pixel doubtful.
    """
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    camera = means @ W.T + t
    # Order and visibility as a float32 machine sees them.
    depth32 = camera[:, 2].detach().float()
    visible = depth32 > near if inria else depth32 >= torch.tensor(near, dtype=torch.float32)
    rows = torch.nonzero(visible)[:, 0]
    rows = rows[torch.argsort(depth32[rows], stable=True)]
    x, y, z = camera[rows].unbind(-1)
    u, v = fx * x / z + cx, fy * y / z + cy
    tan_x, tan_y = 0.5 * width / fx, 0.5 * height / fy
    tx = (x / z).clamp(-cx / fx - 0.3 * tan_x, (width - cx) / fx + 0.3 * tan_x)
    ty = (y / z).clamp(-cy / fy - 0.3 * tan_y, (height - cy) / fy + 0.3 * tan_y)
    clamped = [tx != x / z, ty != y / z]
    zero = torch.zeros_like(x)
    J = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], -1).reshape(-1, 2, 3)
    M = J @ W @ rotations(quats[rows]) * log_scales[rows].exp()[:, None]
    cov = M @ M.mT
    minors = torch.linalg.cross(M[:, 0], M[:, 1])
    det0 = (minors**2).sum(-1)
    trace = cov[:, 0, 0] + cov[:, 1, 1]
    det = det0 + DILATION * trace + DILATION**2
    A, B, C = cov[:, 0, 0] + DILATION, cov[:, 0, 1], cov[:, 1, 1] + DILATION
    opacity = torch.sigmoid(logit_opacities[rows])
    if antialiased:
        ratio = det0 / det
        clamped.append(ratio < 2.5e-5 if inria else torch.zeros_like(clamped[0]))
        opacity = opacity * (ratio.clamp(min=2.5e-5) if inria else ratio).sqrt()

    py, px = torch.meshgrid(
        torch.arange(height, dtype=x.dtype) + 0.5,
        torch.arange(width, dtype=x.dtype) + 0.5,
        indexing="ij",
    )
    dx, dy = px.reshape(1, -1) - u[:, None], py.reshape(1, -1) - v[:, None]
    q = (C[:, None] * dx * dx - 2 * B[:, None] * dx * dy + A[:, None] * dy * dy) / det[:, None]
    raw = opacity[:, None] * torch.exp(-0.5 * q)
    alpha = raw.clamp(max=alpha_max)
    hit = hit_anywhere = alpha >= ALPHA_MIN
    decisions = {"order": rows, "skip": hit}
    if inria:
        decisions["tile"] = inria_tiles(u, v, A, C, det, width, height)
        hit = hit & decisions["tile"]
    near_face = torch.zeros_like(hit)
    if box is not None:
        rays = torch.stack([(px.reshape(-1) - cx) / fx, (py.reshape(-1) - cy) / fy], -1)
        rays = torch.cat([rays, torch.ones_like(rays[:, :1])], -1) @ W
        points = -W.T @ t + z[:, None, None] * rays[None]
        hit = hit & (points >= box[0]).all(-1) & (points < box[1]).all(-1)
        gaps = torch.minimum((points - box[0]).abs(), (points - box[1]).abs()).min(-1).values
        near_face = gaps < 1e-5 * (1 + points.abs().max(-1).values)
    front = torch.ones(height * width, dtype=means.dtype) if light is None else light.reshape(-1)
    alpha = torch.where(hit, alpha, torch.zeros_like(alpha))
    after = front * torch.cumprod(1 - alpha, 0)
    going = after.detach() > STOP
    going = torch.cumprod(going.to(torch.int8), 0).bool()
    alpha = torch.where(going, alpha, torch.zeros_like(alpha))
    after = front * torch.cumprod(1 - alpha, 0)
    before = torch.cat([front[None], after[:-1]]) if len(after) else after
    weight = alpha * before
    left = after[-1] if len(after) else front

    position = -W.T @ t
    direction = means[rows] - position
    direction = direction / direction.norm(dim=-1, keepdim=True).clamp(min=1e-15)
    sh = torch.cat([sh0.reshape(-1, 1, 3), shN], 1)[rows]
    rgb = 0.5 + (sh_basis(direction, sh.shape[1])[..., None] * sh).sum(1)
    decisions |= {"stop": going, "clip": hit & going & (raw > alpha_max), "dark": rgb < 0}
    decisions["clamp"] = torch.stack(clamped)
    rgb = rgb.clamp(min=0)
    bg = torch.tensor(background, dtype=means.dtype)
    image = weight.T @ rgb + left[:, None] * bg
    crossing = (weight > 0) & (before >= 0.5) & (after < 0.5)
    median = torch.where(crossing, z[:, None], torch.zeros_like(weight)).sum(0)

    near_edge = ((raw / ALPHA_MIN - 1).abs() < 1e-4) | ((raw / alpha_max - 1).abs() < clip_margin)
    near_stop = (
        (torch.cumprod(1 - torch.where(hit, raw.clamp(max=alpha_max), 0 * raw), 0) / STOP) - 1
    ).abs() < 1e-3
    N = len(means)
    full = torch.zeros(N, height * width, dtype=means.dtype)
    full_before = full.clone()
    full[rows] = weight.detach()
    full_before[rows] = torch.where(hit & going, before, torch.zeros_like(before)).detach()
    return Oracle(
        image=image.reshape(height, width, 3),
        alpha=(1 - left).reshape(height, width),
        depth=(weight.T @ z if len(rows) else 0 * left).reshape(height, width),
        median=median.reshape(height, width),
        weight=full,
        before=full_before,
        doubtful=(near_edge | near_stop | (near_face & hit_anywhere)).any(0).reshape(height, width),
        decisions=decisions,
    )


def inria_tiles(
    u: Tensor, v: Tensor, A: Tensor, C: Tensor, det: Tensor, width: int, height: int
) -> Tensor:
    """(N, P): pixels in the 16×16 tiles that INRIA's kernel walks for each splat."""
    mid = 0.5 * (A + C)
    radius = torch.ceil(3 * torch.sqrt(mid + torch.sqrt(torch.clamp(mid**2 - det, min=0.1))))
    ix = torch.arange(width).repeat(height)[None] // 16
    iy = torch.arange(height).repeat_interleave(width)[None] // 16
    inside = torch.ones(len(u), width * height, dtype=torch.bool)
    for centre, index, tiles in ((u - 0.5, ix, -(-width // 16)), (v - 0.5, iy, -(-height // 16))):
        low = torch.clamp(((centre - radius) / 16).trunc(), 0, tiles)
        high = torch.clamp(((centre + radius + 15) / 16).trunc(), 0, tiles)
        inside &= (index >= low[:, None]) & (index < high[:, None])
    return inside
