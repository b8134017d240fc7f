"""Assemble the links of a chain: matches, odometry, and constant motion along remaining directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Flags, Floats
from gpusense.chaining.front import Front
from gpusense.chaining.graph import solve
from gpusense.chaining.links import MOTION, ODOMETRY, Links
from gpusense.chaining.motion import constant_motion_deviation, fitted_motion, odometry_links, relative
from gpusense.localization.motion import OdometryMotion

TEMPERATURE = 0.04
"""Factor of the information of matches: recorded scans have repeating errors that no single match reveals."""
# Least share of the largest eigenvalue for an observed direction of a scan's links.
_OPEN = 1e-6
# Least relative gain of the cost of a further iteration in fits of the odometry's noise: fitted variances change by
# less than 0.1 %.
_GAIN = 1e-5
# Deviations of a pose along an unobserved direction [m, rad].
_UNKNOWN, _UNKNOWN_TURN = 30.0, 3.0


def weighed(front: Front) -> Links:
    """Return the matches so far with their information multiplied by the temperature.

    Scans between two key scans are matched to both and share their errors, so both matches count as one.
    """
    links, keys = front.links, np.array(front.keys)
    is_key = np.zeros(front.done, bool)
    is_key[keys] = True
    between = np.append(np.diff(keys), front.done - keys[-1]) - 1
    share = 1 / np.maximum(between, 1)[np.searchsorted(keys, np.arange(front.done), "right") - 1]
    other = np.where(is_key[links.first], links.second, links.first)
    star = is_key[links.first] != is_key[links.second]
    factor = TEMPERATURE * np.where(star, share[other], 1.0)
    return replace(links, information=factor[:, None, None] * links.information)


def links_of_odometry(front: Front, links: Links, reported: Floats, motion: OdometryMotion) -> Links:
    """Return links of odometry: between successive key scans, and to scans that lack other links in a direction."""
    nodes = np.arange(1, front.done)
    keys = np.array(front.keys)
    wanted = _is_open(front.done, links) | np.isin(nodes, keys)
    second = nodes[wanted]
    first = keys[np.searchsorted(keys, second) - 1]
    return shared_odometry(ODOMETRY, first, second, reported, motion)


def shared_odometry(
    kind: str, first: NDArray[np.int64], second: NDArray[np.int64], reported: Floats, motion: OdometryMotion
) -> Links:
    """Return links from the poses (M, 3) of an odometer at nodes."""
    return Links.of(kind, first, second, *odometry_links(motion, reported[first], reported[second]))


def fitted_odometry(front: Front, links: Links, reported: Floats) -> OdometryMotion:
    """Return the noise of the odometry, fitted to the matches."""
    keys = np.array(front.keys)
    poses = solve(front.poses, links, settle=True, least=_GAIN).poses
    whole = np.append(0, np.cumsum(front.lost > 0))[keys]
    return fitted_motion(reported[keys], poses[keys], np.diff(whole) == 0)


def constant_motion_links(poses: Floats, keys: NDArray[np.int64], jumped: Flags, links: Links) -> Links:
    """Return links of constant motion along directions that other links leave open; their errors accumulate.

    ``jumped`` (M - 1,) marks jumps of the time from a node to the next without a match.
    """
    second = np.arange(1, len(poses))[_is_open(len(poses), links)]
    first = keys[np.searchsorted(keys, second) - 1]
    steps = relative(poses, np.arange(len(poses) - 1), np.arange(1, len(poses)))
    deviation = np.cumsum(np.concatenate([np.zeros((1, 2)), constant_motion_deviation(steps)]), axis=0)
    spread = deviation[second] - deviation[first]
    broken = np.append(0, np.cumsum(jumped))
    spread[broken[second] != broken[first]] = _UNKNOWN, _UNKNOWN_TURN
    information = np.zeros((len(first), 3, 3))
    information[:, 0, 0] = information[:, 1, 1] = spread[:, 0] ** -2
    information[:, 2, 2] = spread[:, 1] ** -2
    return Links.of(MOTION, first, second, relative(poses, first, second), information)


def _is_open(count: int, links: Links) -> Flags:
    """Return whether the links to earlier scans leave a direction of a node open; the first node counts as known."""
    total = np.zeros((count, 3, 3))
    np.add.at(total, links.second, links.information)
    values = np.linalg.eigvalsh(total[1:])
    is_open: Flags = values[:, 0] <= _OPEN * np.maximum(values[:, -1], 1e-300)
    return is_open
