"""Likelihood of features by the landmarks near to where each of them points, book table 6.5.

Landmarks lie in square buckets, row by row; start has the first of each bucket. A feature looks into the buckets that a
disc around its end point touches, and evaluates the landmarks within the disc; what is farther cannot matter.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from . import error_free, landmarks
from .landmarks import AXIS, FALSE_POSITIVE, FARTHEST, FEATURE, HOLE, RADIUS, REACH
from .prelude import kernel, precision


@functools.cache
def functions(flags):
    """bucket_at, near, with_landmark and search specialised by the flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    add_term = error_free.functions(flags & {"FLOAT64"}).add_term
    density = landmarks.functions(flags & {"FLOAT64", "RANGE", "BEARING", "SIGNATURE", "FIELD"})
    offset, log_detection = density.offset, density.log_detection
    MARGINAL = "MARGINAL" in flags
    ZERO, ONE = real(0.0), real(1.0)
    NEVER = real(-math.inf)
    # A sum of densities is kept relative to one of them until another is e to this larger.
    RELATIVE = real(4.0)

    # What a search finds: log density of the likeliest landmark, or with MARGINAL of all, that one's, and its place;
    # and the sum of densities relative to found.
    @wp.struct
    class Match:
        found: real
        best: real
        chosen: wp.int32
        total: vec2

    # Row or column of the bucket at a position; the nearest one outside.
    @wp.func
    def bucket_at(position: real, size: real, count: wp.int32):
        return int(wp.clamp(wp.floor(position / size), ZERO, real(count - 1)))

    # Whether a landmark lies in a feature's disc, and within the limits of the sensor that it does not measure.
    @wp.func
    def near(off: vec4, turned: vec4, feature: wp.array(dtype=real), one: wp.int32):
        reach = feature[one + REACH]
        radius = feature[one + RADIUS]
        hole = feature[one + HOLE]
        x = off[0] - reach * turned[0]
        y = off[2] - reach * turned[2]
        squared = off[0] * off[0] + off[2] * off[2]
        if x * x + y * y > radius * radius or squared < hole * hole:
            return False
        d = wp.sqrt(squared)
        return d <= feature[one + FARTHEST] and turned[0] * off[0] + turned[2] * off[2] >= feature[one + AXIS] * d

    # A match and one more landmark.
    @wp.func
    def with_landmark(match: Match, log_p: real, j: wp.int32):
        if MARGINAL:
            if wp.isinf(match.found):
                match.found = log_p
                match.total = vec2(wp.where(wp.isinf(log_p), ZERO, ONE), ZERO)
            elif log_p > match.found + RELATIVE:
                match.total = match.total * wp.exp(match.found - log_p) + vec2(ONE, ZERO)
                match.found = log_p
            else:
                match.total = add_term(match.total, wp.exp(log_p - match.found))
        if log_p > match.best:
            match.best = log_p
            match.chosen = j
        return match

    @wp.func
    def search(
        landmark: wp.array(dtype=vec4),
        signature: wp.array(dtype=vec4),
        start: wp.array(dtype=wp.int32),
        place: vec4,
        turned: vec4,
        feature: wp.array(dtype=real),
        one: wp.int32,
        terms: wp.array(dtype=real),
        arcs: wp.array(dtype=vec2),
        rows: wp.int32,
        cols: wp.int32,
        size: real,
    ):
        match = Match()
        match.found = NEVER
        match.best = NEVER
        match.chosen = -1
        match.total = vec2(ZERO, ZERO)
        reach = feature[one + REACH]
        radius = feature[one + RADIUS]
        if radius < ZERO:
            return match
        x = place[0] + reach * turned[0]
        y = place[2] + reach * turned[2]
        left = bucket_at(x - radius, size, cols)
        right = bucket_at(x + radius, size, cols)
        high = bucket_at(y + radius, size, rows)
        row = bucket_at(y - radius, size, rows)
        while row <= high:
            j = start[row * cols + left]
            last = start[row * cols + right + 1]
            while j < last:
                off = offset(landmark[j], place)
                if near(off, turned, feature, one):
                    match = with_landmark(match, log_detection(off, turned, feature, one, signature[j], terms, arcs), j)
                j += 1
            row += 1
        if MARGINAL:
            if not wp.isinf(match.found):
                match.found = match.found + wp.log(match.total[0] + match.total[1])
        else:
            match.found = match.best
        return match

    return SimpleNamespace(bucket_at=bucket_at, near=near, search=search)


@functools.cache
def make(name, flags):
    """The kernel score_features specialised by the flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    add_term = error_free.functions(flags & {"FLOAT64"}).add_term
    density = landmarks.functions(flags & {"FLOAT64", "RANGE", "BEARING", "SIGNATURE", "FIELD"})
    sensor_place, direction, offset = density.sensor_place, density.direction, density.offset
    log_detection, either = density.log_detection, density.either
    search = functions(flags - {"KNOWN", "PER_BEAM"}).search
    KNOWN = "KNOWN" in flags
    PER_BEAM = "PER_BEAM" in flags
    ZERO, NEVER = real(0.0), real(-math.inf)

    # One work-item a particle: the sum of log p over features, with the partner that is KNOWN, of all landmarks
    # (MARGINAL), or of the likeliest one. With PER_BEAM also what each feature adds, and its likeliest landmark's place
    # in the buckets, -1 where a false positive is likelier. share is log(1 / landmarks), the prior of each one with
    # MARGINAL and else 0.
    @kernel
    def score_features(
        landmark: wp.array(dtype=vec4),
        signature: wp.array(dtype=vec4),
        start: wp.array(dtype=wp.int32),
        pose_cell: wp.array(dtype=wp.vec2i),
        pose: wp.array(dtype=vec4),
        pose_low: wp.array(dtype=vec4),
        feature: wp.array(dtype=real),
        partner: wp.array(dtype=wp.int32),
        terms: wp.array(dtype=real),
        arcs: wp.array(dtype=vec2),
        log_p: wp.array(dtype=real),
        parts: wp.array(dtype=real),
        which: wp.array(dtype=wp.int32),
        rows: wp.int32,
        cols: wp.int32,
        landmarks: wp.int32,
        particles: wp.int32,
        features: wp.int32,
        size: real,
        share: real,
        fixed: real,
        temperature: real,
    ):
        n = wp.tid()
        if n >= particles:
            return
        own = pose[n]
        low = pose_low[n]
        place = sensor_place(pose_cell[n], own, low, size)
        total = vec2(fixed, ZERO)
        lost = bool(False)
        first = int(0)
        while first < features:
            last = wp.min(first + error_free.BLOCK_TERMS, features)
            block = real(0.0)
            k = first
            while k < last:
                one = FEATURE * k
                turned = direction(own, low, feature, one)
                found = real(0.0)
                best = real(0.0)
                chosen = int(0)
                if KNOWN:
                    chosen = partner[k]
                    found = log_detection(
                        offset(landmark[chosen], place), turned, feature, one, signature[chosen], terms, arcs
                    )
                else:
                    match = search(
                        landmark, signature, start, place, turned, feature, one, terms, arcs, rows, cols, size
                    )
                    found = match.found
                    best = match.best
                    chosen = match.chosen
                value = either(found + share, feature[one + FALSE_POSITIVE])
                if wp.isinf(value):
                    lost = True
                else:
                    block += value
                if PER_BEAM:
                    parts[n * features + k] = value
                    if KNOWN:
                        which[n * features + k] = chosen
                    else:
                        which[n * features + k] = wp.where(best + share >= feature[one + FALSE_POSITIVE], chosen, -1)
                k += 1
            total = add_term(total, block)
            first = last
        log_p[n] = wp.where(lost, NEVER, temperature * (total[0] + total[1]))

    return {"score_features": score_features}[name]
