"""Figures of runs of the verdict: false alarms, misses, ROC and reliability."""

from __future__ import annotations

import ast
import itertools
import json
import math

import numpy as np

from gpusense.evaluation.machine import machine, machine_line

FIELDS = ("group", "name", "case", "other", "people", "moved", "glass", "seed")
ERROR, HEADING, P_LOST, WORD, RATIO, DEVIATION = range(6)
LATE = 20
THRESHOLDS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95)
BINS = (0.0, 0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 1.0)


def read(files):
    """Return the runs of shards: (fields of the job, rows)."""
    found = []
    for file in files:
        with np.load(file) as data:
            ends = np.cumsum(data["lengths"])
            parts = np.split(data["rows"], ends[:-1])
            for text, rows in zip(data["jobs"], parts, strict=True):
                found.append((dict(zip(FIELDS, ast.literal_eval(str(text)), strict=True)), rows.astype(np.float64)))
    return found


def labelled(job, rows):
    """Return which scans have a right pose, which are off by the definition of p_lost, and which are off for long."""
    known = np.isfinite(rows[:, ERROR])
    wrong = np.full(len(rows), job["case"] == "wrong")
    near = known & ~wrong & (rows[:, ERROR] < 1) & (rows[:, HEADING] < 0.5)
    off = (known & ~near) | wrong
    far = (known & (rows[:, ERROR] > 2)) | wrong
    since, late = 0, np.zeros(len(rows), bool)
    for k, one in enumerate(far):
        if known[k] or wrong[k]:
            since = since + 1 if one else 0
        late[k] = since > LATE and one
    return near, off, late


def figures(found):
    """Return figures of runs."""
    parts = [(rows, *labelled(job, rows)) for job, rows in found]
    rows = np.concatenate([part[0] for part in parts])
    near, late = (np.concatenate([part[k] for part in parts]) for k in (1, 3))
    p, word = rows[:, P_LOST], rows[:, WORD]
    finals = [_final(*part) for part in parts]
    judged = [one for one in finals if one is not None]
    return dict(
        runs=len(found), scans=len(rows), right=int(near.sum()), late=int(late.sum()),
        false=_share(p[near] > 0.5), false_word=_share(word[near] == 2), not_tracking=_share(word[near] != 0),
        missed=_share(p[late] <= 0.5), missed_tracking=_share(word[late] == 0), uncertain=_share(word[late] == 1),
        finals=len(judged), finals_wrong=sum(not one for one in judged), auroc=auroc(p, near, late),
    )  # fmt: skip


def _final(rows, near, off, late):
    """Return whether the last verdict is right; None where the last pose is neither right nor off for long."""
    if near[-1]:
        return rows[-1, P_LOST] <= 0.5
    return rows[-1, P_LOST] > 0.5 if late[-1] else None


def _share(values):
    return float(np.mean(values)) if len(values) else None


def auroc(p, near, late):
    """Return the area under the ROC curve of p for scans off for long against right ones."""
    from scipy.stats import rankdata

    values = np.concatenate([p[late], p[near]])
    one, two = int(late.sum()), int(near.sum())
    if not one or not two:
        return None
    return float((rankdata(values)[:one].sum() - one * (one + 1) / 2) / (one * two))


def roc(found):
    """Return (threshold, share of right scans above, share of late ones above)."""
    parts = [(rows, *labelled(job, rows)) for job, rows in found]
    p = np.concatenate([part[0][:, P_LOST] for part in parts])
    near, late = (np.concatenate([part[k] for part in parts]) for k in (1, 3))
    return [(t, _share(p[near] > t), _share(p[late] > t)) for t in THRESHOLDS]


def reliability(found):
    """Return (low, high, scans, mean of p_lost, share that is off) of bins of p_lost."""
    parts = [(rows, *labelled(job, rows)) for job, rows in found]
    p = np.concatenate([part[0][:, P_LOST] for part in parts])
    near, off = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    known, result = near | off, []
    for k, (low, high) in enumerate(itertools.pairwise(BINS)):
        chosen = known & (p >= low) & ((p < high) | (k == len(BINS) - 2))
        result.append((low, high, int(chosen.sum()), _share(p[chosen]), _share(off[chosen])))
    return result


def at_share(bins, share=0.1):
    """Return the share of each bin that is off where `share` of all scans are, by weights of scans that are off.

    A study has more wrong poses than a robot's day. Its other scans keep their weight.
    """
    off = sum(count * happened for _, _, count, _, happened in bins if count)
    right = sum(count for _, _, count, _, _ in bins) - off
    weight = share / (1 - share) * right / off if off else math.nan
    return [
        None if not count else weight * happened / (weight * happened + 1 - happened)
        for _, _, count, _, happened in bins
    ]


def _text(value, form=".2f", scale=100.0):
    return "-" if value is None else f"{scale * value:{form}}"


def _line(name, r):
    return (
        f"| {name} | {r['runs']} | {_text(r['false'])} | {_text(r['false_word'])} | {_text(r['not_tracking'])} | "
        f"{_text(r['missed'])} | "
        f"{_text(r['missed_tracking'])} | {r['finals'] - r['finals_wrong']} of {r['finals']} | "
        f"{_text(r['auroc'], '.4f', 1.0)} |"
    )


_HEAD = (
    "| runs of | runs | false alarms [%] | said 'lost' [%] | right, not tracking [%] | missed [%] "
    "| missed, tracking [%] | last verdict right | AUROC |",
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
)


def reliability_table(groups):
    """Return the lines of the table of groups of bins."""
    text = "Reliability: scans of a range of p_lost, its mean, the share that is off by 1 m or 0.5 rad"
    weighted = [at_share(bins) for bins in groups.values()]
    lines = [f"{text}, and that share where a tenth of all scans is off", ""]
    lines += ["| p_lost | " + " | ".join(groups) + " |", "| --- |" + " --- |" * len(groups)]
    for k in range(len(BINS) - 1):
        cells = [
            f"{bins[k][2]}: {', '.join(_text(value, '.3f', 1.0) for value in (bins[k][3], bins[k][4], at[k]))}"
            for bins, at in zip(groups.values(), weighted, strict=True)
        ]
        lines.append(f"| {BINS[k]} to {BINS[k + 1]} | {' | '.join(cells)} |")
    return lines


def commands(files):
    """Return the commands that made shards."""
    for file in files:
        with np.load(file) as data:
            yield str(data["command"])


def write(files, out):
    """Print the page of shards, and write it with its figures."""
    found = read(files)
    groups = {name: [one for one in found if one[0]["group"] == name] for name in ("tuning", "held out", "simulated")}
    groups = {name: chosen for name, chosen in groups.items() if chosen}
    lines, result = [*_HEAD], {}
    for name, chosen in groups.items():
        result[name] = figures(chosen)
        lines.append(_line(f"**{name}**", result[name]))
        for field in ("case", "people", "moved", "glass", "name"):
            for value in sorted({job[field] for job, _ in chosen}, key=str):
                part = [one for one in chosen if one[0][field] == value]
                if len(part) < len(chosen):
                    label = value if isinstance(value, str) else f"{field} {100 * value:.0f} %"
                    result[f"{name}, {field} {value}"] = figures(part)
                    lines.append(_line(f"{name}: {label}", result[f"{name}, {field} {value}"]))
    lines += ["", "ROC: share of right scans, and of scans off for long, with p_lost above a threshold [%]", ""]
    lines += ["| threshold | " + " | ".join(groups) + " |", "| --- |" + " --- |" * len(groups)]
    curves = {name: roc(chosen) for name, chosen in groups.items()}
    for k, threshold in enumerate(THRESHOLDS):
        cells = " | ".join(f"{_text(curve[k][1])}, {_text(curve[k][2])}" for curve in curves.values())
        lines.append(f"| {threshold} | {cells} |")
    lines += [""]
    bins = {name: reliability(chosen) for name, chosen in groups.items()}
    lines += reliability_table(bins)
    print("\n".join(lines))
    if out is not None:
        made = list(commands(files))
        document = dict(machine=machine(), commands=made, figures=result, roc=curves, reliability=bins)
        out.write_text(json.dumps(document, indent=1))
        table = "\n".join(lines)
        text = "\n".join(f"`python {command}`\\" for command in made)
        out.with_suffix(".md").write_text(f"{machine_line()}\n\n{text}\n`--join`\n\n{table}\n")
