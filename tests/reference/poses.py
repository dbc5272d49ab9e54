"""Naive twins of the occupancy grid's queries, and small scenes whose free space is known exactly."""

import numpy as np

from g2ard.scene.splats import Splats


def king_steps(cells, reach):
    """Distance of every cell to the nearest true one in king's moves, by looking at each of them."""
    targets = np.argwhere(cells)
    index = np.argwhere(np.ones_like(cells))
    if not len(targets):
        return np.full(cells.shape, reach)
    far = np.abs(index[:, None] - targets[None]).max(axis=2).min(axis=1)
    return np.minimum(far, reach).reshape(cells.shape)


def first_hit(cells, low, cell, eye, direction, step=0.01):
    """Distance along a ray to the first true cell, in tiny steps; inf if it leaves the box."""
    span = np.linalg.norm(np.array(cells.shape)) * cell + np.linalg.norm(eye - low)
    for t in np.arange(0, 2 * span, step * cell):
        place = np.floor((eye + t * direction - low) / cell).astype(int)
        if (place >= 0).all() and (place < cells.shape).all() and cells[tuple(place)]:
            return t
    return np.inf


def cast_rays(steps, low, cell, eyes, directions):
    """`_core.cast_rays`, all rays a stride at a time: the same sums, in the same order, in float64."""
    shape = np.array(steps.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (np.stack([low, low + cell * shape])[:, None] - eyes) / directions
    near = np.where(np.isnan(ends).any(axis=0), -np.inf, ends.min(axis=0)).max(axis=1)
    far = np.where(np.isnan(ends).any(axis=0), np.inf, ends.max(axis=0)).min(axis=1)
    reached, hits = np.maximum(near, 0) + 0.01 * cell, np.full(len(eyes), np.inf)
    rows = np.flatnonzero(reached < far)
    while len(rows):
        place = np.floor((eyes[rows] + reached[rows, None] * directions[rows] - low) / cell)
        ahead = steps[tuple(np.clip(place, 0, shape - 1).astype(int).T)]
        hits[rows[ahead == 0]] = reached[rows[ahead == 0]]
        reached[rows] += cell * np.maximum(ahead - 1.0, 0.6)
        rows = rows[(ahead > 0) & (reached[rows] < far[rows])]
    return hits


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def discs(points, normals, radius, seed=0):
    """Opaque flat Gaussians, no two alike, on a surface."""
    n, rng = len(points), np.random.default_rng(seed)
    z = np.array([0.0, 0.0, 1.0])
    w = 1 + normals @ z
    quats = np.concatenate([w[:, None], np.cross(z, normals)], axis=1)
    quats[w < 1e-9] = (0, 1, 0, 0)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = radius * np.array([1, 1, 0.1]) * rng.uniform(0.8, 1.2, (n, 1))
    return Splats.create(
        np.asarray(points, np.float64),
        quats=quats,
        scales=scales,
        logit_opacities=rng.uniform(2, 4, n),
        sh0=rng.normal(size=(n, 1, 3)),
    )


def joined(*parts):
    fields = ("means", "quats", "scales", "logit_opacities", "sh0")
    return Splats.create(**{f: np.concatenate([getattr(p, f) for p in parts]) for f in fields})


def moved(splats, turn=None, scale=1.0, shift=(0.0, 0.0, 0.0)):
    """The scene turned, then scaled, then moved, in float64."""
    from dataclasses import replace

    turn = np.eye(3) if turn is None else turn
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    axis = skew / np.linalg.norm(skew) if np.linalg.norm(skew) > 0 else np.array([1.0, 0, 0])
    a, b = np.cos(angle / 2), np.sin(angle / 2) * axis
    w, v = splats.quats[:, :1].astype(float), splats.quats[:, 1:].astype(float)
    quats = np.concatenate([a * w - v @ b[:, None], a * v + w * b + np.cross(b, v)], axis=1)
    return replace(
        splats,
        means=scale * (splats.means @ turn.T) + np.asarray(shift, float),
        quats=quats.astype(np.float32) if turn.any() and angle > 0 else splats.quats,
        scales=(splats.scales * scale).astype(np.float32),
    )


def rectangle(corner, a, b, spacing, normal):
    """Jittered points of a rectangle, and its normal for each."""
    a, b = np.array(a, float), np.array(b, float)
    n, m = (max(2, round(np.linalg.norm(v) / spacing)) for v in (a, b))
    rng = np.random.default_rng(n * 1000 + m)
    u = (np.repeat(np.arange(n), m) + rng.random(n * m)) / n
    v = (np.tile(np.arange(m), n) + rng.random(n * m)) / m
    points = np.array(corner, float) + u[:, None] * a + v[:, None] * b
    return discs(points, np.tile(np.array(normal, float), (n * m, 1)), spacing, seed=n + 7 * m)


def box(low, high, spacing, floor=True):
    """The six faces of a box (five without the lower one)."""
    (x, y, z), (dx, dy, dz) = low, np.subtract(high, low)
    faces = [
        ((x, y, z + dz), (dx, 0, 0), (0, dy, 0), (0, 0, 1)),
        ((x, y, z), (dx, 0, 0), (0, 0, dz), (0, 1, 0)),
        ((x, y + dy, z), (dx, 0, 0), (0, 0, dz), (0, 1, 0)),
        ((x, y, z), (0, dy, 0), (0, 0, dz), (1, 0, 0)),
        ((x + dx, y, z), (0, dy, 0), (0, 0, dz), (1, 0, 0)),
    ]
    if floor:
        faces.append(((x, y, z), (dx, 0, 0), (0, dy, 0), (0, 0, 1)))
    return joined(*(rectangle(c, a, b, spacing, n) for c, a, b, n in faces))


def sphere(centre, radius, spacing):
    from g2ard.scene.reproducible import fibonacci

    outward = fibonacci(int(4 * np.pi * radius**2 / spacing**2))
    return discs(np.array(centre, float) + radius * outward, outward, spacing)


def statue():
    """A hollow ball of radius 1 hovering 1.3 over a round ground of radius 3; z up."""
    k = np.arange(9000)
    r, t = 3 * np.sqrt((k + 0.5) / len(k)), k * 2.399963
    ground = np.stack([r * np.cos(t), r * np.sin(t), np.zeros(len(k))], axis=1)
    flat = discs(ground, np.tile([0.0, 0.0, 1.0], (len(k), 1)), 0.06, seed=1)
    return joined(flat, sphere((0, 0, 1.3), 1.0, 0.06))


TABLES = (((0.5, 0.5, 0.0), (1.7, 1.3, 0.75)), ((4.2, 2.4, 0.0), (5.6, 3.6, 0.5)))


def room():
    """6 × 4 × 2.7 with two solid tables on the floor; z up."""
    return joined(box((0, 0, 0), (6, 4, 2.7), 0.07), *(box(*t, 0.07, floor=False) for t in TABLES))


HOUSES = tuple(
    (
        (12.0 * i + 3, 12.0 * j + 3, 0.0),
        (12.0 * i + 9, 12.0 * j + 9, 3.0 + 2.0 * ((3 * i + 5 * j) % 4)),
    )
    for i in range(5)
    for j in range(4)
)


def town():
    """60 × 48 of ground with twenty hollow houses, streets 6 wide; z up."""
    ground = rectangle((0, 0, 0), (60, 0, 0), (0, 48, 0), 0.3, (0, 0, 1))
    return joined(ground, *(box(*h, 0.3, floor=False) for h in HOUSES))
