"""What the system believes, as a picture and a sentence: the posterior over latents, as tasks."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_poem.label.families import Description, as_points, describe

# Training tasks from which the task of a latent is read.
NEIGHBOURS = 5
# The sentence names the range that holds so much of the posterior.
SHARE = 0.8
# Speeds, m/s, that are one to who watches; what is no faster stands still.
ONE_SPEED, STILL = 0.3, 0.1
# Degrees from a word up to which people say "straight", and up to which "a bit".
STRAIGHT, BIT = 8.0, 30.0
# Degrees to either side that say nothing about a direction.
ANY_WAY = 60.0
# Half the width of a picture, m, up to which distances in it are told in centimetres.
NEARBY = 0.5
# Of a distance in space, the part towards who looks or away that is worth saying.
DEEP = 0.5
#: A place is not sure where the posterior reaches as far from it as this share of its distance
UNSURE = 0.5
NOTHING_YET = "It knows nothing yet of what you want."


def belief(adapter: Any, env_id: str) -> dict[str, Any]:
    """The posterior of an adapter, ready to draw.

    :param adapter: A ``PreferenceAdapter``, or what has its ``model`` and ``inference``.
    :param env_id: The environment's id, which says how tasks are drawn.
    :return: JSON-ready: ``picture`` ("place", "speed", "direction" or "projection"), ``points`` (n,
        1 or 2), ``weights`` (n,) summing to one, ``estimate`` (the point of the policy that would
        be taken now), ``extent``, ``unit``, ``words`` (what is to the right, upwards, to the left
        and downwards) and ``sentence``.
    """
    latents, weights = adapter.inference.posterior()
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
        "points": np.round(points[:, :2], 4).tolist(),
        "weights": np.round(weights, 6).tolist(),
        "estimate": np.round(estimate[:2], 4).tolist(),
        "extent": float(extent),
        "unit": unit,
        "words": list(description.words),
        "sentence": sentence(description, points, weights, estimate)
        if adapter.inference.answers
        else NOTHING_YET,
    }


def believed_in_words(adapter: Any, env_id: str) -> str:
    """:func:`belief` in a sentence, for who sees no picture."""
    believed = belief(adapter, env_id)
    if believed["picture"] != "projection":
        return str(believed["sentence"])
    numbers = ", ".join(f"{value:.3g}" for value in adapter.inference.estimate())
    return f"It takes the policy of the latent ({numbers})."


def sentence(
    description: Description, points: np.ndarray, weights: np.ndarray, estimate: np.ndarray
) -> str:
    """The posterior in words: points (n, 1 to 3), weights (n,), the estimate's point."""
    picture, words = description.picture, description.words
    if picture == "speed":
        return f"It believes that you want it to {_speed(description, points, weights, estimate)}."
    if picture == "direction":
        return _direction_sentence(words, points, weights, estimate)
    if picture == "place":
        distance = float(np.linalg.norm(estimate))
        away = np.linalg.norm(points - estimate, axis=1)
        radius = weighted_quantiles(away, weights, (SHARE,))[0]
        if radius >= distance:
            far = _length(description, distance + radius)
            within = f"within about {far} of" if description.unit else "not far from"
            return f"It believes that you mean a place {within} where it begins."
        where = way(words, estimate)
        beyond = estimate[2] if len(estimate) == 3 else 0.0
        if abs(beyond) >= DEEP * distance:
            where += f", {'farther from' if beyond > 0 else 'nearer to'} you"
        if description.unit:
            far, about = (_length(description, length) for length in (distance, radius))
            where += f", about {far} away, give or take {about}"
        elif radius >= UNSURE * distance:
            where += ", but is not sure yet"
        return f"It believes that you mean a place {where}."
    return (
        "Each dot is a behaviour that still fits your answers; the closer together they lie, the "
        "surer it is."
    )


def way(words: Sequence[str], point: np.ndarray) -> str:
    """The direction of a point (2,), by the words for right, upwards, left and downwards."""
    degrees = float(np.degrees(np.arctan2(point[1], point[0])))
    nearest = round(degrees / 90)
    off = degrees - 90 * nearest
    word, other = words[nearest % 4], words[(nearest + (1 if off > 0 else -1)) % 4]
    aside = nearest % 2 == 0
    if abs(off) <= STRAIGHT:
        return f"straight to the {word}" if aside else f"straight {word}"
    if abs(off) <= BIT:
        return f"to the {word} and a bit {other}" if aside else f"a bit {other} of straight {word}"
    return f"{other} and to the {word}" if aside else f"{word} and to the {other}"


def _speed(
    description: Description, points: np.ndarray, weights: np.ndarray, estimate: np.ndarray
) -> str:
    low, high = weighted_quantiles(points[:, 0], weights, ((1 - SHARE) / 2, (1 + SHARE) / 2))
    if high <= STILL:
        return "stand still, or nearly"
    if high - low < ONE_SPEED:
        return f"run at about {max(estimate[0], STILL):.1f} {description.unit}"
    if low <= STILL:
        return f"run at {high:.1f} {description.unit} or less"
    return f"run at {low:.1f} to {high:.1f} {description.unit}"


def _length(description: Description, length: float) -> str:
    if description.extent <= NEARBY:
        return f"{max(round(100 * length), 1)} cm"
    rounded = round(2 * length) / 2 if length >= 1 else max(round(length, 1), 0.1)
    return f"{rounded:g} {description.unit}"


def weighted_quantiles(
    values: np.ndarray, weights: np.ndarray, shares: tuple[float, ...]
) -> list[float]:
    """The smallest value (n,) of a sample, weighted (n,), at or below which each share lies."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    places = np.searchsorted(cumulative, np.asarray(shares) * cumulative[-1])
    return values[order[np.minimum(places, len(order) - 1)]].tolist()


def _direction_sentence(
    words: Sequence[str], points: np.ndarray, weights: np.ndarray, estimate: np.ndarray
) -> str:
    if np.abs(points[:, 1]).max() < 1e-9:  # one line: forward or backward
        forward = float(weights[points[:, 0] >= 0].sum())
        side, share = ("right", forward) if forward >= 0.5 else ("left", 1.0 - forward)
        return f"It is {100 * share:.0f} % sure that you want it to run to the {side} in the film."
    angles = np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(estimate[1], estimate[0])
    away = np.abs(np.angle(np.exp(1j * angles)))
    spread = np.degrees(weighted_quantiles(away, weights, (SHARE,))[0])
    if spread > ANY_WAY:
        return "It does not know yet which way you want it to go."
    where, about = way(words, estimate), max(round(spread), 1)
    return f"It believes that you want it to go {where}, give or take {about} degrees."


def _points_of(model: Any, latents: np.ndarray, train_points: np.ndarray) -> np.ndarray:
    """(m, 1 to 3) tasks of latents (m, d): the mean of the nearest training tasks', weighted."""
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
