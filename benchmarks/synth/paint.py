"""Colours of surfaces: patterns by material, then sun, sky light and cast shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.synth.layout import PITCH, ROAD, Layout, Material
from benchmarks.synth.noise import Array, Noise, band, hash01, ramp
from benchmarks.synth.shapes import Float, cast

__all__ = ["SUN", "Painter"]

SUN = np.array([-0.42, -0.55, 0.72]) / np.linalg.norm([-0.42, -0.55, 0.72])
"""Unit vector towards the sun."""
_SUNLIGHT = np.array([0.84, 0.78, 0.68], np.float32)
_SKYLIGHT = np.array([0.52, 0.56, 0.62], np.float32)
_SHADOW_SIDE = 3072
_SHADOW_CELL = 0.1


@dataclass(frozen=True, eq=False)
class _Spots:
    """Surface points for paint functions: float32 arrays, (n,) or (3, n)."""

    p: Array
    n: Array
    lo: Array  # corner of the primitive
    hi: Array
    colour: Array
    parameters: Array
    primitive: NDArray[np.int64]
    u: Array  # metres along the surface, sideways and upwards (on top: x and y)
    v: Array
    wu: Array  # footprint along u and v, metres
    wv: Array
    top: NDArray[np.bool_]


def _mix(base: Array, over: Array | tuple[float, ...], share: Array) -> Array:
    if isinstance(over, tuple):
        over = np.asarray(over, np.float32)[:, None]
    return base + (over - base) * share


def _tones(s: _Spots, u: Array, v: Array, cell: tuple[float, float], amplitude: float) -> Array:
    """Return (n,) random tones per cell of a primitive's grid, mean 0, fading if a pixel spans many cells."""
    tone = hash01(np.floor(u / cell[0]), np.floor(v / cell[1]), s.primitive) - np.float32(0.5)
    return tone * np.float32(amplitude) / (1 + (np.maximum(s.wu, s.wv) / min(cell)) ** 4)


def _to_edge(s: _Spots) -> Array:
    """Return (n,) horizontal distances to the nearest side of the primitive's bounding box, metres."""
    inset = np.minimum(s.p - s.lo, s.hi - s.p)
    return np.minimum(inset[0], inset[1])


class _Shadows:
    """Depth along the sun's rays on a fine grid, compared with four neighbours and blended."""

    def __init__(self, layout: Layout) -> None:
        self._east = np.cross([0.0, 0.0, 1.0], SUN)
        self._east /= np.linalg.norm(self._east)
        self._north = np.cross(SUN, self._east)
        lo, hi = layout.shapes.lo.min(0), layout.shapes.hi.max(0)
        corners = np.array(
            [[x, y, z] for x in (lo[0], hi[0]) for y in (lo[1], hi[1]) for z in (0, hi[2])]
        )
        a, b = corners @ self._east, corners @ self._north
        self._start = np.array([a.min(), b.min()])
        span = np.array([np.ptp(a), np.ptp(b)])
        self.cell = max(_SHADOW_CELL, span.max() / _SHADOW_SIDE)
        self._columns, self._rows = (np.ceil(span / self.cell).astype(int) + 1).tolist()
        self._high = float((corners @ SUN).max()) + 1.0
        self._depth = self._trace(layout)

    def _trace(self, layout: Layout) -> NDArray[np.float32]:
        """Return the (rows, columns) height along the sun's direction of the first surface."""
        tile = 64
        depth = np.empty((self._rows, self._columns), np.float32)
        for row in range(0, self._rows, tile):
            rows = np.arange(row, min(row + tile, self._rows))
            for column in range(0, self._columns, tile):
                columns = np.arange(column, min(column + tile, self._columns))
                a = self._start[0] + self.cell * columns[None, None]
                b = self._start[1] + self.cell * rows[None, :, None]
                at = (
                    a * self._east[:, None, None]
                    + b * self._north[:, None, None]
                    + self._high * SUN[:, None, None]
                ).reshape(3, -1)
                t, _ = cast(layout.shapes, at, np.broadcast_to(-SUN[:, None], at.shape))
                depth[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = (
                    self._high - t
                ).reshape(len(rows), -1)
        return depth

    def lit(self, p: Float, facing: Array) -> Array:
        """Return the (n,) share of sunlight at points p (3, n), whose normals have cosine `facing`."""
        x = (self._east @ p - self._start[0]) / self.cell
        y = (self._north @ p - self._start[1]) / self.cell
        level = (SUN @ p).astype(np.float32)
        slope = np.sqrt(1 - np.minimum(facing, 1) ** 2) / np.maximum(facing, 0.1)
        level += (0.02 + self.cell * (0.5 + slope)).astype(np.float32)  # above the grid's steps
        x0 = np.clip(x.astype(np.int64), 0, self._columns - 2)
        y0 = np.clip(y.astype(np.int64), 0, self._rows - 2)
        fx, fy = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
        flat, at = self._depth.ravel(), y0 * self._columns + x0
        near = (flat[at] <= level) * (1 - fx) + (flat[at + 1] <= level) * fx
        at += self._columns
        far = (flat[at] <= level) * (1 - fx) + (flat[at + 1] <= level) * fx
        return near * (1 - fy) + far * fy


class Painter:
    """Colours of points on a layout's surfaces, for photos and point clouds."""

    def __init__(self, layout: Layout, seed: int) -> None:
        self._layout = layout
        self._noise = Noise(seed)
        self._shadows = _Shadows(layout)
        self._paints = {
            Material.GROUND: self._ground,
            Material.BLOCK: self._block,
            Material.FACADE: self._facade,
            Material.TILES: self._tiles,
            Material.LEAVES: self._leaves,
            Material.PLAIN: self._plain,
        }

    def __call__(
        self, p: Float, normal: Float, direction: Float, primitive: NDArray[np.int64], width: Float
    ) -> NDArray[np.float32]:
        """Return (3, n) colours in [0, 1].

        Args:
            p: (3, n) points on the surfaces.
            normal: (3, n) outward unit normals.
            direction: (3, n) unit viewing directions.
            primitive: (n,) indices of surfaces.
            width: (n,) sample widths across the ray, metres.
        """
        spots = self._spots(p, normal, direction, primitive, width)
        albedo = np.empty(p.shape, np.float32)
        materials = self._layout.materials[primitive]
        for material in np.unique(materials):
            at = np.flatnonzero(materials == material)
            albedo[:, at] = self._paints[Material(material)](_select(spots, at))
        facing = np.maximum(SUN @ normal, 0.0).astype(np.float32)
        sun = facing * self._shadows.lit(p + 0.02 * normal, facing)
        # Ambient light from the sky and the ground, less near the ground.
        open_ = (0.72 + 0.28 * normal[2] + 0.12 * np.minimum(p[2] / 6, 1.0) - 0.06).astype(
            np.float32
        )
        light = _SUNLIGHT[:, None] * sun + _SKYLIGHT[:, None] * open_
        return np.clip(albedo * light * 1.12, 0.0, 1.0)

    def _spots(
        self, p: Float, normal: Float, direction: Float, primitive: NDArray[np.int64], width: Float
    ) -> _Spots:
        layout = self._layout
        dominant = np.argmax(np.abs(normal), axis=0)
        top, side_x = dominant == 2, dominant == 0
        u = np.where(side_x, p[1], p[0])
        v = np.where(top, p[1], p[2])
        # A pixel's footprint stretches by 1/cos along the view's projection onto the surface.
        cosine = np.maximum(np.abs((direction * normal).sum(0)), 0.05)
        du = np.where(side_x, direction[1], direction[0]) / cosine
        dv = np.where(top, direction[1], direction[2]) / cosine
        f = np.float32
        return _Spots(
            p=p.astype(f),
            n=normal.astype(f),
            lo=layout.shapes.lo[primitive].T.astype(f),
            hi=layout.shapes.hi[primitive].T.astype(f),
            colour=layout.colours[primitive].T,
            parameters=layout.parameters[primitive].T,
            primitive=primitive,
            u=u.astype(f),
            v=v.astype(f),
            wu=(width * np.sqrt(1 + du * du)).astype(f),
            wv=(width * np.sqrt(1 + dv * dv)).astype(f),
            top=top,
        )

    def _grain(self, s: _Spots, *octaves: tuple[float, float]) -> Array:
        """Return 1 ± noise of (wavelength, amplitude) octaves, with an offset per primitive."""
        shift = hash01(s.primitive) * np.float32(199.0)
        wide = np.maximum(s.wu, s.wv)
        out: Array = np.ones_like(wide)
        for wavelength, amplitude in octaves:
            out = out + np.float32(amplitude) * self._noise(
                s.u + shift, s.v - shift, wavelength, wide
            )
        return out

    def _grass(self, s: _Spots) -> Array:
        green = np.array([0.40, 0.45, 0.26], np.float32)[:, None]
        dry = self._noise(s.u, s.v, 6.0, np.maximum(s.wu, s.wv))
        tint = np.array([0.12, 0.05, 0.03], np.float32)[:, None]
        return (green + tint * dry) * self._grain(s, (0.12, 0.22), (0.5, 0.14), (2.0, 0.10))

    def _ground(self, s: _Spots) -> Array:
        """Paint asphalt with markings on the street grid, and grass beyond it."""
        reach = self._layout.reach
        x, y, wx, wy = s.p[0], s.p[1], s.wu, s.wv
        off_x, off_y = (self._from_street(x, 0), self._from_street(y, 1))
        on_x, on_y = 1 - ramp(np.abs(off_x), ROAD, wx), 1 - ramp(np.abs(off_y), ROAD, wy)
        paint = np.maximum(
            self._markings(off_x, y, wx, wy, off_y) * on_x * (1 - on_y),
            self._markings(off_y, x, wy, wx, off_x) * on_y * (1 - on_x),
        )
        asphalt = s.colour * self._grain(s, (0.07, 0.16), (0.4, 0.10), (3.0, 0.12), (14.0, 0.10))
        patch = np.clip(self._noise(x, y, 9.0, np.maximum(wx, wy)) * 6 - 2.4, 0, 1)
        asphalt = asphalt * (1 - 0.25 * patch)
        worn = 0.85 + 0.15 * self._noise(x, y, 0.3, np.maximum(wx, wy))
        road = _mix(asphalt, (0.86, 0.86, 0.82), paint * worn)
        beyond_x, beyond_y = np.abs(x) - np.float32(reach[0]), np.abs(y) - np.float32(reach[1])
        outside = np.maximum(ramp(beyond_x, ROAD + 0.4, wx), ramp(beyond_y, ROAD + 0.4, wy))
        return _mix(road, self._grass(s), outside)

    def _from_street(self, at: Array, axis: int) -> Array:
        """Return the signed distance to the nearest street's centre line."""
        pitch = np.float32(PITCH[axis])
        first = np.float32(self._layout.streets(axis)[0])
        k = np.clip(np.rint((at - first) / pitch), 0, self._layout.blocks)
        return at - first - k * pitch

    @staticmethod
    def _markings(
        across: Array, along: Array, w_across: Array, w_along: Array, crossing: Array
    ) -> Array:
        """Return the coverage by white paint: dashed centre line, edge lines, zebra crossings."""
        line = band(np.abs(across), -0.08, 0.08, w_across, 1e3) * band(
            along, 0.0, 3.0, w_along, 7.5
        )
        edge = band(np.abs(across), 3.0, 3.12, w_across, 1e3)
        to_crossing = np.abs(crossing)
        zebra = band(to_crossing, ROAD + 1.0, ROAD + 4.0, w_along, 1e3) * band(
            across, 0.25, 0.75, w_across, 1.0
        )
        stop = band(to_crossing, ROAD + 4.8, ROAD + 5.2, w_along, 1e3) * (np.abs(across) < 3.0)
        free = ramp(to_crossing, ROAD + 5.2, w_along)
        return np.maximum(
            np.maximum(line, edge) * free, np.maximum(zebra * (np.abs(across) < 4.6), stop)
        )

    def _block(self, s: _Spots) -> Array:
        """Paint paving slabs around the lot, a curb, and grass or a yard inside."""
        wide = np.maximum(s.wu, s.wv)
        joint = 1 - 0.28 * np.maximum(
            band(s.u, 0.0, 0.025, s.wu, 0.6), band(s.v, 0.0, 0.025, s.wv, 0.6)
        )
        slab = _tones(s, s.u, s.v, (0.6, 0.6), 0.14)
        paving = s.colour * (self._grain(s, (0.05, 0.08), (1.2, 0.07), (9.0, 0.05)) + slab) * joint
        edge = _to_edge(s)
        paving = _mix(paving, (0.72, 0.71, 0.69), 1 - ramp(edge, 0.3, wide))
        within = ramp(edge, 2.9, wide) * s.parameters[0]
        middle = (s.lo + s.hi) / 2
        path = np.maximum(
            1 - ramp(np.abs(s.p[0] - middle[0]), 1.8, s.wu),
            1 - ramp(np.abs(s.p[1] - middle[1]), 1.8, s.wv),
        )
        gravel = np.array([0.66, 0.58, 0.46], np.float32)[:, None] * self._grain(
            s, (0.06, 0.2), (0.8, 0.08)
        )
        green = _mix(self._grass(s), gravel, path * s.parameters[1])
        return _mix(paving, green, within)

    def _facade(self, s: _Spots) -> Array:
        wall = s.colour * self._grain(s, (0.06, 0.06), (0.5, 0.06), (3.0, 0.07))
        brick = np.maximum(
            band(s.v, 0.0, 0.014, s.wv, 0.085),
            band(s.u + 0.125 * (np.floor(s.v / np.float32(0.085)) % 2), 0.0, 0.014, s.wu, 0.25),
        )
        tone = _tones(s, s.u, s.v, (0.25, 0.085), 0.35)
        wall = wall * (1 + tone * s.parameters[4])
        wall = _mix(wall, (0.70, 0.67, 0.62), brick * s.parameters[4] * 0.7)
        return np.where(s.top, self._flat_roof(s), self._windows(s, wall))

    def _flat_roof(self, s: _Spots) -> Array:
        edge = _to_edge(s)
        gravel = np.tile(
            np.float32(0.46) * self._grain(s, (0.15, 0.2), (1.0, 0.12), (6.0, 0.12)), (3, 1)
        )
        return _mix(gravel, s.colour * np.float32(0.9), 1 - ramp(edge, 0.4, s.wu))

    def _windows(self, s: _Spots, wall: Array) -> Array:
        """Paint a grid of framed panes with random tones, shop fronts below and a cornice above."""
        pitch, storey, share_u, share_v, _ = s.parameters
        along_y = np.abs(s.n[0]) > 0.5
        start = np.where(along_y, s.lo[1], s.lo[0])
        width = np.where(along_y, s.hi[1], s.hi[0]) - start
        columns = np.maximum(1, np.rint((width - 0.8) / pitch))
        scale = columns / (width - 0.8)
        u, wu = (s.u - start - 0.4) * scale, s.wu * scale  # in panes, from the first
        v, wv = (s.v - s.lo[2]) / storey, s.wv / storey
        floors = np.floor((s.hi[2] - s.lo[2] - 0.1) / storey)
        inside = ((u > 0) & (u < columns) & (v < floors)).astype(np.float32)
        column, floor = np.floor(u), np.floor(v)
        shop = (floor == 0) & (s.lo[2] < 1) & (hash01(s.primitive, 5) < 0.5) & (floors > 2)
        lo_u, hi_u = (
            np.where(shop, 0.06, 0.5 - share_u / 2),
            np.where(shop, 0.94, 0.5 + share_u / 2),
        )
        lo_v, hi_v = (
            np.where(shop, 0.12, 0.52 - share_v / 2),
            np.where(shop, 0.74, 0.52 + share_v / 2),
        )
        rim_u, rim_v = 0.09 * scale, 0.09 / storey
        frame = (
            band(u, lo_u - rim_u, hi_u + rim_u, wu)
            * band(v, lo_v - rim_v, hi_v + rim_v, wv)
            * inside
        )
        pane = band(u, lo_u, hi_u, wu) * band(v, lo_v, hi_v, wv) * inside
        cross = band(u, 0.5 - rim_u / 3, 0.5 + rim_u / 3, wu) * pane
        tone = hash01(column, floor, s.primitive)
        glass = np.stack([0.10 + 0.16 * tone, 0.14 + 0.17 * tone, 0.20 + 0.17 * tone])
        blind = (hash01(column, floor, s.primitive, 3) < 0.25) * ramp(
            v - floor, lo_v + 0.3 * share_v, wv
        )
        glass = _mix(glass, (0.72, 0.68, 0.58), blind * 0.8)
        trim = 0.25 * wall + np.array([0.68, 0.66, 0.63], np.float32)[:, None]
        out = _mix(wall, trim, frame)
        out = _mix(out, glass, pane)
        out = _mix(out, trim, cross * np.float32(0.9))
        course = band(v, 0.0, 0.05, wv) * (floor >= 1) * (floor < floors + 1)
        out = _mix(out, trim * np.float32(0.85), course * (1 - frame) * 0.7)
        awning = np.stack(
            [hash01(s.primitive, k) * np.float32(0.6) + np.float32(0.15) for k in (11, 12, 13)]
        )
        return _mix(out, awning, band(v, 0.78, 0.97, wv, 1e3) * shop * inside)

    def _tiles(self, s: _Spots) -> Array:
        row = band(s.v, 0.0, 0.05, s.wv, 0.24)
        column = band(s.u + 0.15 * (np.floor(s.v / np.float32(0.24)) % 2), 0.0, 0.03, s.wu, 0.3)
        tone = _tones(s, s.u, s.v, (0.3, 0.24), 0.3)
        return (
            s.colour
            * (self._grain(s, (0.8, 0.08), (4.0, 0.1)) + tone)
            * (1 - 0.4 * np.maximum(row, column))
        )

    def _leaves(self, s: _Spots) -> Array:
        wide = np.maximum(s.wu, s.wv)
        leaf_u, leaf_v = s.u + np.float32(0.5) * s.v, s.v - np.float32(0.5) * s.u
        leaf = _tones(s, leaf_u, leaf_v, (0.09, 0.09), 0.5)
        yellow = np.array([0.12, 0.06, 0.0], np.float32)[:, None]
        tint = s.colour + yellow * self._noise(s.u, s.v, 0.7, wide)
        return tint * (self._grain(s, (0.17, 0.35), (0.45, 0.40), (1.1, 0.18)) + leaf)

    def _plain(self, s: _Spots) -> Array:
        return s.colour * self._grain(s, (0.05, 0.05), (0.4, 0.08))


def _select(s: _Spots, at: NDArray[np.int64]) -> _Spots:
    return _Spots(**{name: getattr(s, name)[..., at] for name in _Spots.__dataclass_fields__})
