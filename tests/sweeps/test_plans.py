"""Jobs, plans and tables of sweeps: their arguments, contents and survival of a crash."""

from __future__ import annotations

import csv
import pickle
import re
import tracemalloc

import pytest

import gpusense as gs
from gpusense.sweeps.process import Outcome
from gpusense.sweeps.table import Table

PLAN = """
options: {every: 2, parameters: {sigma_hit: 0.1}}
axes:
  log:
    one: {log: one.log, map: a.yaml}
    two: {log: two.log, map: b.yaml, range_max: 20}
  model: [field, discrete]
  weights:
    plain: {temperature: 1.0}
    tempered: {temperature: auto, stages: 4}
  seed: 3
"""


def plan(tmp_path, text):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    return path


def test_a_plan_is_the_product_of_its_axes(tmp_path):
    jobs = gs.sweep.read_plan(plan(tmp_path, PLAN))
    assert len(jobs) == 2 * 2 * 2 * 3 == len({job.key for job in jobs})
    first, last = jobs[0], jobs[-1]
    assert (first.task, first.log, first.map, first.model, first.seed) == ("localize", "one.log", "a.yaml", "field", 0)
    assert dict(first.options) == {"every": 2, "parameters.sigma_hit": 0.1, "temperature": 1.0}
    assert dict(last.labels) == {"log": "two", "model": "discrete", "weights": "tempered", "seed": 2}
    assert last.option("range_max") == 20 and last.group("parameters") == {"sigma_hit": 0.1}
    assert pickle.loads(pickle.dumps(last)) == last and hash(last) == hash(pickle.loads(pickle.dumps(last)))


def test_a_key_is_that_of_all_but_the_labels():
    job = gs.sweep.Job(map="m", log="l", options={"b": 1, "a": [1.5, None]}, labels={"x": "y"})
    assert job.key == gs.sweep.Job(map="m", log="l", options=(("a", (1.5, None)), ("b", 1))).key == "341f277fc019e3b3"
    others = dict(task="fit", map="n", log="k", model="beam", seed=1, options={"b": 1})
    assert len({gs.sweep.Job(**{"map": "m", "log": "l", name: value}).key for name, value in others.items()}) == 6


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task: 'os:system'", "task: must be one of 'localize', 'score', 'fit', got 'os:system'"),
        ("axes: {model: [laser]}", "model: must be one of"),
        ("axes: {particle: [500]}", "options: of the task localize are"),
        ("axes: {log: {one: run.log}}", "axes.log.one: must be a list, or a mapping"),
        ("axes: {seed: 100000, particles: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]}", "must make 1 to 1000000 jobs"),
        ("axes: {particles: [500, 500]}", "axes: must make different jobs, got 1 twice"),
        ("options: {particles: .nan}", "options.particles: must be finite"),
        ("axes: {particles: []}", "must make 1 to 1000000 jobs, got 0"),
        ("jobs: 3", "plan: must have task, options, axes only, got 'jobs'"),
        ("options: !!python/object/apply:os.getpid []", "must be plain YAML"),
    ],
)
def test_a_bad_plan_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=r"plan\.yaml: .*") as error:
        gs.sweep.read_plan(plan(tmp_path, text))
    assert message in str(error.value)


def outcome(value, error=""):
    return Outcome({} if error else {"value": value}, error, 0.5, 0.4, "host:1", "numpy")


def test_a_table_keeps_all_bits_and_survives_a_torn_line(tmp_path):
    path = tmp_path / "t.csv"
    jobs = [
        gs.sweep.Job(task="fit", seed=seed, options={"block": 3}, labels={"log": 'one, "two"'}) for seed in range(4)
    ]
    with Table(path) as table:
        table.add(jobs[1], outcome(0.1 + 0.2), 1)
        table.add(jobs[0], outcome(0, 'ValueError: a,\n "b"'), 2)
        with pytest.raises(OSError, match="one sweep at a time"):
            Table(path, resume=True)
    whole = path.read_bytes()
    assert whole.count(b"\n") == 3 and len(list(csv.reader(whole.decode().splitlines()))) == 3
    path.write_bytes(whole + b"0123456789abcdef,done,fi")
    columns = gs.sweep.read_table(path)
    assert columns["key"] == [jobs[1].key, jobs[0].key] and columns["value"] == [0.1 + 0.2, None]
    assert columns["error"] == [None, 'ValueError: a, "b"'] and columns["axis.log"] == ['one, "two"'] * 2
    with Table(path, resume=True) as table:
        assert list(table.rows) == [jobs[1].key, jobs[0].key] and path.read_bytes() == whole
        more = outcome(2.0)
        more.values["other"] = True
        table.add(jobs[2], more, 1)
        table.finish([job.key for job in jobs])
    columns = gs.sweep.read_table(path)
    assert columns["seed"] == [0, 1, 2] and columns["other"] == [None, None, True]
    with pytest.raises(FileExistsError, match="exists: resume it"):
        Table(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "must be the table of a sweep"),
        ("\x00\xff\n", "must be"),
        ("notes", "must be the table of a sweep, got b'notes'"),
    ],
)
def test_another_file_is_no_table(tmp_path, text, message):
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode("latin1"))
    for read in (lambda: Table(path, resume=True), lambda: gs.sweep.read_table(path)):
        with pytest.raises(ValueError, match=message):
            read()
    assert path.read_bytes() == text.encode("latin1")


def test_a_parquet_file_has_the_columns_of_the_csv_file(tmp_path):
    pytest.importorskip("pyarrow")
    jobs = [gs.sweep.Job(task="fit", seed=seed) for seed in range(3)]
    with Table(tmp_path / "t.parquet") as table:
        for job in jobs:
            table.add(job, outcome(job.seed / 3, "no" if job.seed == 1 else ""), 1)
        table.finish([job.key for job in jobs])
    assert gs.sweep.read_table(tmp_path / "t.parquet") == gs.sweep.read_table(tmp_path / "t.csv")


LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 10)}]\n" for k in range(8)
)
MERGES = "a: &a {k: x}\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} {{<<: [{', '.join([f'*{chr(97 + k)}'] * 10)}]}}\n" for k in range(8)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LAUGHS, "its aliases must repeat at most 100000 values"),
        (MERGES, "its aliases must repeat at most 100000 values"),
        ("options: {" + LAUGHS.replace("\n", ", ") + "}", "its aliases must repeat at most 100000 values"),
        ("options: &o {inner: *o}", "no part may contain itself, got *o within &o"),
        ("axes: &x [[*x]]", "no part may contain itself"),
        ("options: " + "{a: " * 200 + "1" + "}" * 200, "its parts must be nested at most 100 deep"),
        ("options: " + "{a: " * 50 + "1" + "}" * 50, "options: must be nested at most 32 deep"),
        (f"options: {{a: [{'1,' * 20000}1]}}\naxes: {{seed: 10000}}", "options: must have at most 50000000 values"),
        (f"options: {{task: {'x' * 900000}}}\naxes: {{seed: 10000}}", "options: must have at most 50000000 values"),
        (f"axes: {{log: {{one: {{a: [{'1,' * 20000}1]}}}}, seed: 10000}}", "options: must have at most 50000000"),
    ],
    ids=["laughs", "merges", "laughs-in-options", "self", "self-in-list", "deep", "deep-options", "product", "text",
         "product-of-axes"],
)  # fmt: skip
def test_a_plan_that_grows_without_bound_is_refused_at_once(tmp_path, text, message):
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=re.escape(message)) as caught:
            gs.sweep.read_plan(plan(tmp_path, text))
        assert tracemalloc.get_traced_memory()[1] < 60e6
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 500


def test_aliases_that_stay_small_are_read(tmp_path):
    text = "options: &all {every: 2}\naxes: {places: {one: {<<: *all, log: a}, two: {<<: *all, log: b, every: 3}}}"
    assert [dict(job.options) for job in gs.sweep.read_plan(plan(tmp_path, text))] == [{"every": 2}, {"every": 3}]


def test_options_that_contain_themselves_are_no_options():
    for options in ({"a": []}, {"a": {}}):
        inner = options["a"]
        inner.append(inner) if isinstance(inner, list) else inner.update(b=inner)
        with pytest.raises(ValueError, match="options: must be nested at most 32 deep"):
            gs.sweep.Job(options=options)
    wide = [0]
    for _ in range(20):
        wide = [wide, wide]
    with pytest.raises(ValueError, match="options: must hold at most 100000 values"):
        gs.sweep.Job(options={"a": wide})
