"""What the system believes, as a picture and a sentence: the posterior over latents, as tasks."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_poem.label.families import as_points, describe

# Training tasks from which the task of a latent is read.
NEIGHBOURS = 5
# The sentence names the range that holds so much of the posterior.
SHARE = 0.8
# Of the eighths of a circle, in a video that looks at the robot from its right side.
WAYS = (
    *("right", "far right", "away from you", "far left"),
    *("left", "near left", "towards you", "near right"),
)


def belief(adapter: Any, env_id: str) -> dict[str, Any]:
    """The posterior of an adapter, ready to draw.

    :param adapter: A ``PreferenceAdapter``, or what has its ``model`` and ``inference``.
    :param env_id: The environment's id, which says how tasks are drawn.
    :return: JSON-ready: ``picture`` ("place", "speed", "direction" or "projection"), ``points`` (n,
        1 or 2), ``weights`` (n,) summing to one, ``estimate`` (the point of the policy that would
        be taken now), ``extent``, ``unit`` and ``sentence``.
    """
    latents, weights = posterior(adapter.inference)
    everything = np.concatenate([latents, adapter.inference.estimate()[None, :]])
    tasks = np.asarray(adapter.model.train_tasks.tasks, dtype=np.float64)
    description = describe(env_id, tasks.shape[1])
    picture, extent, unit = description.picture, description.extent, description.unit
    if picture == "projection":
        points, extent = _projection(adapter.model, everything)
    else:
        points = _points_of(adapter.model, everything, as_points(env_id, tasks))
    points, estimate = points[:-1], points[-1]
    return {
        "picture": picture,
        "points": np.round(points, 4).tolist(),
        "weights": np.round(weights, 6).tolist(),
        "estimate": np.round(estimate, 4).tolist(),
        "extent": float(extent),
        "unit": unit,
        "sentence": sentence(picture, points, weights, estimate, unit),
    }


def posterior(inference: Any) -> tuple[np.ndarray, np.ndarray]:
    """The latents (n, d) that are still possible, and weights (n,) summing to one."""
    if hasattr(inference, "particles"):
        return inference.particles, inference.weights
    candidates = inference.candidates
    return candidates, np.full(len(candidates), 1.0 / len(candidates))


def sentence(
    picture: str, points: np.ndarray, weights: np.ndarray, estimate: np.ndarray, unit: str
) -> str:
    """The posterior in words: points (n, 1 or 2), weights (n,), the estimate's point."""
    if picture == "speed":
        low, high = weighted_quantiles(points[:, 0], weights, ((1 - SHARE) / 2, (1 + SHARE) / 2))
        return f"It believes that you want between {max(low, 0.0):.1f} and {high:.1f} {unit}."
    if picture == "direction":
        return _direction_sentence(points, weights)
    if picture == "place":
        distances = np.linalg.norm(points - estimate, axis=1)
        radius = weighted_quantiles(distances, weights, (SHARE,))[0]
        across, upwards, about = (f"{round(value, 2):.2g}" for value in (*estimate, radius))
        where = f"near {across} across and {upwards} up, give or take {about} {unit}".strip()
        return f"It believes that you mean a place {where}."
    return (
        "Each dot is a behaviour that still fits your answers; the closer together they lie, the "
        "surer it is."
    )


def weighted_quantiles(
    values: np.ndarray, weights: np.ndarray, shares: tuple[float, ...]
) -> list[float]:
    """The smallest value (n,) of a sample, weighted (n,), at or below which each share lies."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    places = np.searchsorted(cumulative, np.asarray(shares) * cumulative[-1])
    return values[order[np.minimum(places, len(order) - 1)]].tolist()


def _direction_sentence(points: np.ndarray, weights: np.ndarray) -> str:
    if np.abs(points[:, 1]).max() < 1e-9:  # one line: forward or backward
        forward = float(weights[points[:, 0] >= 0].sum())
        way, share = ("right", forward) if forward >= 0.5 else ("left", 1.0 - forward)
        return f"It is {100 * share:.0f} % sure that you want it to run to the {way} in the video."
    x, y = weights @ points
    angle = np.arctan2(y, x)
    away = np.abs(np.angle(np.exp(1j * (np.arctan2(points[:, 1], points[:, 0]) - angle))))
    spread = np.degrees(weighted_quantiles(away, weights, (SHARE,))[0])
    way = WAYS[round(angle / (np.pi / 4)) % 8]
    return (
        f"It believes that you mean the direction {way} in the video, give or take "
        f"{spread:.0f} degrees."
    )


def _points_of(model: Any, latents: np.ndarray, train_points: np.ndarray) -> np.ndarray:
    """(m, 1 or 2) tasks of latents (m, d): the mean of the nearest training tasks', weighted."""
    means, variances = model.train_tasks.latent_means, model.train_tasks.latent_variances
    spread = means.var(axis=0)
    # What training has left unused says nothing of the task; there the prior's spread would drown
    # the rest.
    scale = np.sqrt(spread / np.maximum(spread + variances.mean(axis=0), 1e-12))
    distances = np.linalg.norm((latents[:, None, :] - means[None, :, :]) * scale, axis=2)
    nearest = np.argsort(distances, axis=1)[:, :NEIGHBOURS]
    closeness = 1.0 / (np.take_along_axis(distances, nearest, axis=1) + 1e-3)
    closeness /= closeness.sum(axis=1, keepdims=True)
    return np.einsum("mk,mkp->mp", closeness, train_points[nearest])


def _projection(model: Any, latents: np.ndarray) -> tuple[np.ndarray, float]:
    """(m, 2) latents on the plane in which the training tasks' differ most, and half its width."""
    means = model.train_tasks.latent_means
    centre = means.mean(axis=0)
    axes = np.linalg.svd(means - centre, full_matrices=False)[2][:2]
    if len(axes) < 2:
        axes = np.eye(2, means.shape[1])
    points, train_points = (latents - centre) @ axes.T, (means - centre) @ axes.T
    if points.shape[1] < 2:
        points = np.concatenate([points, np.zeros_like(points)], axis=1)
    return points, 1.2 * max(float(np.abs(train_points).max()), float(np.abs(points).max()))
