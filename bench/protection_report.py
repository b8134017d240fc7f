"""Figures of runs with protection levels."""

from __future__ import annotations

import ast
import itertools
import math

import numpy as np
from common import table

from gpusense.localization.protection import MARGIN, WIDENING

GROUPS = ("tuning", "held out", "simulated")
RISKS = (0.01, 0.05)
# Factors of the radius and margins [m] that are compared.
CHOICES = ((2.0, 0.0), (1.5, 0.0), (1.5, 0.05), (1.25, 0.03), (WIDENING, MARGIN), (1.0, 0.05), (1.0, 0.1))
# Columns of a row, the last of which are the radii of the risks, without factor and margin.
ERROR, HEADING, P_LOST, WORD, RADII = range(5)
# Radius up to which a position can be used [m]; scans of a block.
ALERT_LIMIT, BLOCK = 0.5, 13
COLUMNS = (
    "runs of", "risk [%]", "runs", "scans", "excesses", "excesses [%]", "upper 95 % limit [%]",
    "available at 0.5 m while right [%]", "median radius [cm]", "scans to an alert: median, most; within 5",
)  # fmt: skip


def jump_of(events):
    """Return the index of the first scan after a jump of the truth that the odometry does not have; None without."""
    for k, (before, after) in enumerate(itertools.pairwise(events)):
        if math.dist(before.truth[:2], after.truth[:2]) > 2 and math.dist(before.odometry[:2], after.odometry[:2]) < 1:
            return k + 1
    return None


def read(files):
    """Return the runs of shards: (group, name, case, seed, index of the jump or -1, rows)."""
    found = []
    for file in files:
        with np.load(file) as data:
            parts = np.split(data["rows"].astype(np.float64), np.cumsum(data["lengths"])[:-1])
            found += [(*ast.literal_eval(str(job)), rows) for job, rows in zip(data["jobs"], parts, strict=True)]
    return found


def is_right(rows):
    """Return which poses of known truth are right by the definition of p_lost."""
    return (rows[:, ERROR] < 1) & (rows[:, HEADING] < 0.5)


def figures(found, risk, rng, widening=WIDENING, margin=MARGIN):
    """Return figures of runs at a risk.

    Excesses are scans whose error is larger than their radius, of all scans with a reference; available are radii of at
    most ``ALERT_LIMIT``, of the scans whose pose is right; late are the scans from a jump to the first radius above.
    """
    excesses, blocks, available, radii, late = [], [], [], [], []
    for _, _, _, _, jump, rows in found:
        radius = widening * rows[:, RADII + RISKS.index(risk)] + margin
        known, right = np.isfinite(rows[:, ERROR]), is_right(rows)
        over = (rows[:, ERROR] > radius)[known]
        excesses.append(over)
        blocks += [over[k : k + BLOCK].mean() for k in range(0, len(over), BLOCK)]
        available.append(radius[right] <= ALERT_LIMIT)
        radii.append(radius[right & np.isfinite(radius)])
        if jump >= 0 and radius[jump - 1] <= ALERT_LIMIT and rows[jump - 1, ERROR] < ALERT_LIMIT:
            alert = np.flatnonzero((radius[jump:] > ALERT_LIMIT) | (rows[jump:, ERROR] < ALERT_LIMIT))
            late.append(int(alert[0]) if len(alert) else len(rows) - jump)
    share, radii = np.concatenate(excesses), np.concatenate(radii)
    return dict(
        runs=len(found), scans=len(share), blocks=len(blocks), excesses=int(share.sum()), share=float(share.mean()),
        limit=upper_limit(np.array(blocks), rng), available=float(np.concatenate(available).mean()),
        radius=float(np.median(radii)) if len(radii) else None, late=late,
    )  # fmt: skip


def upper_limit(blocks, rng):
    """Return the upper 95 % limit of the mean of blocks: of a bootstrap, and of as many independent scans.

    The second one counts a block as one scan, so that no excess in n blocks gives about 3 / n.
    """
    from scipy.stats import beta

    count, mean = len(blocks), float(blocks.mean())
    drawn = rng.choice(blocks, (2000, count)).mean(axis=1)
    alone = float(beta.ppf(0.95, mean * count + 1, count * (1 - mean))) if mean < 1 else 1.0
    return max(float(np.quantile(drawn, 0.95)), alone)


def losses_of(found):
    """Return how many poses went wrong from one scan with a reference to the next, and the number of such scans."""
    lost = scans = 0
    for *_, rows in found:
        known, right = np.isfinite(rows[:, ERROR]), is_right(rows)
        pairs = known[1:] & known[:-1]
        lost, scans = lost + int((pairs & right[:-1] & ~right[1:]).sum()), scans + int(pairs.sum())
    return lost, scans


def correlation_length(found):
    """Return the integrated autocorrelation of the errors in radii, in scans: the mean of runs without a jump."""
    lengths = []
    for _, _, case, _, _, rows in found:
        ratio = rows[:, ERROR] / rows[:, -1]
        ratio = ratio[np.isfinite(ratio)]
        if case == "own" and len(ratio) > 100:
            d = ratio - ratio.mean()
            rho = np.array([(d[k:] @ d[: len(d) - k]) / (d @ d) for k in range(1, 60)])
            end = int(np.argmax(rho < 0.05)) if (rho < 0.05).any() else len(rho)
            lengths.append(1 + 2 * float(rho[:end].sum()))
    return float(np.mean(lengths)) if lengths else math.nan


def page(files):
    """Return the page of shards as text, and its figures."""
    found, rng = read(files), np.random.default_rng(0)
    groups = {group: [run for run in found if run[0] == group] for group in GROUPS}
    rows, result = [], {}
    recorded = groups["tuning"] + groups["held out"]
    whole = [run for run in recorded if run[2] == "own"]
    chosen = [("**recorded, whole logs**", whole), *((f"**{group}**", runs) for group, runs in groups.items())]
    for group, runs in groups.items():
        chosen += [(f"{group}: {case}", [run for run in runs if run[2] == case]) for case in ("own", "kidnapped")]
        names = sorted({run[1] for run in runs}) if group != "simulated" else []
        chosen += [(f"{group}: {name}", [run for run in runs if run[1] == name]) for name in names]
    for name, runs in chosen:
        for risk in RISKS if runs else ():
            one = figures(runs, risk, rng)
            result[f"{name.strip('*')}, {risk}"] = one
            late = sorted(one["late"])
            alerts = f"{np.median(late):.0f}, {late[-1]}; {sum(k <= 5 for k in late)} of {len(late)}" if late else "-"
            rows.append((
                name, f"{100 * risk:g}", one["runs"], one["scans"], one["excesses"], f"{100 * one['share']:.2f}",
                f"{100 * one['limit']:.2f}", f"{100 * one['available']:.1f}",
                "-" if one["radius"] is None else f"{100 * one['radius']:.0f}", alerts,
            ))  # fmt: skip
    tuning, factors = [run for run in groups["tuning"] if run[2] == "own"], []
    for factor, margin in CHOICES if tuning else ():
        every = [figures(tuning, risk, rng, factor, margin) for risk in RISKS]
        factors.append([f"{factor:g}, {margin:g}", *(
            f"{100 * one['share']:.2f}, {100 * one['limit']:.2f}; {100 * one['available']:.1f}" for one in every
        )])  # fmt: skip
    lost, scans = losses_of(whole)
    text = "\n\n".join((
        f"Radii times {WIDENING:g} and plus {MARGIN:g} m; blocks of {BLOCK} scans; the errors of recorded runs are "
        f"correlated over {correlation_length(recorded):.1f} scans. On the whole logs {lost} of {scans} went wrong.",
        table(COLUMNS, rows),
        "Excesses on the whole tuning logs by factor and margin [m]: share, upper 95 % limit; availability [%], at a "
        "risk of " + ", ".join(f"{100 * risk:g}" for risk in RISKS) + " %",
        table(("factor, margin", *(f"{100 * risk:g} %" for risk in RISKS)), factors),
    ))  # fmt: skip
    return text, dict(figures=result, factors=factors)
