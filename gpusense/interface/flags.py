"""Flags of kernels: their meaning, and the conditions on which they depend."""

from __future__ import annotations

import functools
from collections.abc import Hashable

from gpusense.interface import casters

FLAGS = {
    "FLOAT64": "real numbers are float64",
    "ORIGINS_OUTSIDE": "some beam starts outside the grid",
    "OUTSIDE_OCCUPIED": "what lies outside the grid is a wall",
    "HIT": "z_hit > 0",
    "SHORT": "z_short > 0",
    "RAND": "z_rand > 0",
    "BIAS": "range_bias is not 0",
    "GROWTH": "sigma_hit grows with range",
    "STUDENT": "the density of a hit is Student's t",
    "MASS_TABLE": "the mass of a hit's density within [0, range_max] comes from a table",
    "EXACT_EXPONENT": "exponents are sums of two numbers, since the peak of the hit density is too high for one",
    "SINGLE": "the mixture has one continuous component",
    "LINEAR": "z_rand is large enough for the mixture to be summed as densities, not as logarithms",
    "STOPS": "a ray ends behind its reading, where an obstacle no longer changes the density",
    "SECTORS_2": "empty rectangles are made for 2 sectors of each quadrant's directions",
    "SECTORS_4": "empty rectangles are made for 4 of them",
    "ROW_GROUPS": "planes of empty rectangles have groups of 8 rows: large maps on GPUs, many worlds on processors",
    **casters.FLAGS,
    "AMCL_LINES": "Bresenham's lines are nav2_amcl's: they look one cell beyond their end, at ranges beyond range_max",
    "BELUGA_LINES": "Bresenham's lines are Beluga's: ties go straight on, and rays from outside the grid meet nothing",
    "CONES": "a sensor hears the nearest return of a cone of rays, or the angle of incidence matters",
    "INCIDENCE": "the angle of incidence chooses the mixture's terms, or says whether anything returns",
    "COSINES": "cosines of angles of incidence are wanted, not the angles",
    "SENSOR_TABLE": "log densities come from a table over readings and expected ranges",
    "CUBES": "a sum of cubes is wanted, as nav2_amcl and Beluga weigh scans",
    "AMCL": "the densities to be cubed are nav2_amcl's, not Beluga's",
    "IN_LANES": "a work-item computes 16 particles or beams at once: vectors on PoCL, loops on Warp's processor device",
    "IN_TEAMS": "the work-items of a group share one item, as matches of scans do on GPUs",
    "SMALL_TEAMS": "an eighth of them share it, where an item has few points or groups hold fewer work-items",
    "READ_AHEAD": "cells of several points are read at once, since GPUs wait for each read",
    "SHARED_RAYS": "several readings have the same bearing",
    "ALL_READINGS": "missing (nan) and max (inf) readings are evaluated too, as they are when nothing is left out",
    "HUGE_HEADINGS": "some heading is beyond 2^20 rad",
    "ORDERED": "particles come in an order in which neighbours have much the same position and heading",
    "STRANDED": "there are enough readings for a work-item to add up whole strands of them",
    "ROUNDED_CELLS": "cells are found by rounding; points near an edge are then repeated with more digits",
    "INSIDE": "no end point of the cloud leaves the field's table",
    "SCANS": "several scans are scored together, each with readings and particles of its own",
    "WORLDS": "each particle is in one of several maps",
    "SHAPES": "worlds have moving shapes",
    "SEES": "poses cast rays, each of which tests only the shapes near its direction",
    "PER_BEAM": "the log-likelihood of each reading is wanted",
    "BILINEAR": "the field is interpolated",
    "LOG_TABLE": "the field's table holds log densities, not distances",
    "POSES_FLOAT32": "poses on the device are float32 numbers, as GPU frameworks hold them, not float64",
    "RANGES_FLOAT32": "readings on the device are float32 numbers, as GPU frameworks hold them, not float64",
    "SOME_BEAMS": "readings on the device are those of more beams than are used",
    "END_POINTS": "readings on the device become end points of beams, not rays with ranges",
    "RANGE": "some feature has a range",
    "BEARING": "some feature has a bearing",
    "SIGNATURE": "some feature has a signature",
    "FIELD": "the field of view is less than a full circle",
    "LINE": "features are lines",
    "KNOWN": "it is known which landmark each feature is",
    "MARGINAL": "each feature's densities at all landmarks are summed",
    "INFORMATION": "the sums of the log-likelihood's second derivatives are wanted",
    "TWO_PART_POINTS": "poses and end points are sums of two numbers, so that end points fall into the right cell",
}


@functools.lru_cache(maxsize=1024)
def flags_if(**conditions: Hashable) -> frozenset[str]:
    """Return the flags whose conditions hold: ``flags_if(HIT=z_hit > 0, RAND=z_rand > 0)``."""
    return frozenset([flag for flag, holds in conditions.items() if holds])
