"""The peers' methods against naive twins."""

import numpy as np
import pytest

import g2ard._core as _core
from benchmarks.baselines.nanogs import _SAMPLES, nanogs
from g2ard.errors import InputError
from g2ard.scene.splats import Splats
from helpers.raster_cases import scene, splats_of
from reference.rotations import rotations

SCENE = splats_of(scene(4, 60, 1))


def unpack(s: Splats) -> list[dict]:
    out = []
    for i in range(len(s)):
        R = rotations(s.quats[i])
        std = s.scales[i].astype(float)
        sh = np.concatenate([s.sh0[i], s.shN[i]]).astype(float)
        alpha = 1 / (1 + np.exp(-float(s.logit_opacities[i])))
        out.append({"mean": s.means[i].astype(float), "R": R, "std": std, "alpha": alpha, "sh": sh})
    return out


def density(g: dict, x: np.ndarray) -> float:
    cov = g["R"] @ np.diag(g["std"] ** 2 + 1e-8) @ g["R"].T
    d = x - g["mean"]
    return float(
        np.exp(-0.5 * d @ np.linalg.inv(cov) @ d) / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(cov))
    )


def merge(a: dict, b: dict) -> tuple[float, dict]:
    """Return the cost and the result of merging two."""
    wa, wb = ((2 * np.pi) ** 1.5 * g["alpha"] * g["std"].prod() + 1e-12 for g in (a, b))
    pa, pb = wa / (wa + wb), wb / (wa + wb)
    mean = pa * a["mean"] + pb * b["mean"]
    cov = 1e-8 * np.eye(3)
    for p, g in ((pa, a), (pb, b)):
        d = g["mean"] - mean
        cov = cov + p * (g["R"] @ np.diag(g["std"] ** 2) @ g["R"].T + np.outer(d, d))
    log_p = 0.0
    for p, g, z in ((pa, a, _SAMPLES[0]), (pb, b, _SAMPLES[1])):
        x = g["mean"] + g["R"] @ (np.sqrt(g["std"] ** 2 + 1e-8) * z)
        log_p += p * np.log(pa * density(a, x) + pb * density(b, x))
    kl = log_p + 0.5 * (3 * np.log(2 * np.pi) + np.log(np.linalg.det(cov)) + 3)
    values, vectors = np.linalg.eigh(cov)
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] *= -1
    alpha = a["alpha"] + b["alpha"] - a["alpha"] * b["alpha"]
    merged = {"mean": mean, "R": vectors, "std": np.sqrt(values), "alpha": alpha}
    return kl + ((a["sh"] - b["sh"]) ** 2).sum(), {**merged, "sh": pa * a["sh"] + pb * b["sh"]}


def naive(s: Splats, budget: int) -> list[dict]:
    g = unpack(s)
    cut = min(0.1, float(np.median([r["alpha"] for r in g])))
    g = [r for r in g if r["alpha"] >= cut]
    assert len(g) > budget
    while len(g) > budget:
        edges = set()
        for i, r in enumerate(g):
            far = sorted(
                (float(((o["mean"] - r["mean"]) ** 2).sum()), j) for j, o in enumerate(g) if j != i
            )
            edges |= {(min(i, j), max(i, j)) for _, j in far[:16]}
        ranked = sorted((merge(g[i], g[j])[0], i, j) for i, j in edges)
        used: set[int] = set()
        new = []
        for _, i, j in ranked:
            if not {i, j} & used and len(new) < min(len(s) // 2, len(g) - budget):
                used |= {i, j}
                new.append(merge(g[i], g[j])[1])
        g = [r for i, r in enumerate(g) if i not in used] + new
    return g


@pytest.mark.parametrize("budget", [33, 7])
def test_nanogs_equals_a_naive_twin(budget: int) -> None:
    found, expected = unpack(nanogs(SCENE, budget)), naive(SCENE, budget)
    assert len(found) == len(expected) == budget
    for f, e in zip(found, expected, strict=True):
        np.testing.assert_allclose(f["mean"], e["mean"], atol=1e-5)
        np.testing.assert_allclose(f["sh"], e["sh"], atol=1e-5)
        assert f["alpha"] == pytest.approx(min(e["alpha"], 1 - 1e-6), abs=1e-5)
        covariances = [g["R"] @ np.diag(g["std"] ** 2) @ g["R"].T for g in (f, e)]
        np.testing.assert_allclose(*covariances, rtol=1e-4, atol=1e-6)


def test_nanogs_counts_are_exact_where_its_cut_would_leave_too_few() -> None:
    kept = nanogs(SCENE, 59)
    assert len(kept) == 59
    weakest = int(np.argmin(SCENE.logit_opacities))
    np.testing.assert_array_equal(kept.means, np.delete(SCENE.means, weakest, 0))


def test_knn_is_brute_force() -> None:
    points = np.random.default_rng(0).normal(size=(300, 3))
    distance = ((points[:, None] - points) ** 2).sum(-1)
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_array_equal(
        _core.knn(points, 9), np.argsort(distance, 1, kind="stable")[:, :9]
    )
    for k in (0, 300):
        with pytest.raises(InputError, match="k: expected 1 to 299"):
            _core.knn(points, k)
    points[7, 2] = np.inf
    with pytest.raises(InputError, match="row 7"):
        _core.knn(points, 3)
