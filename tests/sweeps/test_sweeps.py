"""Sweeps: equal tables on every executor, failures, killed workers and schedulers."""

from __future__ import annotations

import json
from importlib.util import find_spec

import pytest
from support.room_log import write_room
from support.sweep_tasks import swept

import gpusense as gs
from gpusense.commands import cli
from gpusense.evaluation.log_steps import read_steps
from gpusense.evaluation.tracking import Track, follow, start, summary
from gpusense.sweep import Job, ProcessExecutor, SerialExecutor, SweepLost
from gpusense.sweeps.job import contents_of
from gpusense.sweeps.process import work
from gpusense.sweeps.tasks import jobs_of

SMALL = {"limit": 4, "particles": 100, "beams": 20, "range_max": 20}
PLAN = {
    "options": {"map": "map.yaml", "log": "run.log", **SMALL},
    "axes": {"model": ["field", "beam"], "weights": {"plain": {"temperature": 1.0}, "auto": {}}, "seed": 2},
}
dask = pytest.mark.skipif(find_spec("distributed") is None, reason="needs gpusense[sweep]")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    write_room(folder)
    return folder


@pytest.fixture(scope="module")
def processes():
    with ProcessExecutor(2) as executor:
        yield executor


@pytest.fixture(scope="module")
def cluster():
    pytest.importorskip("distributed")
    with gs.sweep.DaskExecutor(devices=["numpy", "numpy"]) as executor:
        yield executor


def made(name, count, **options):
    return [Job(task=f"support.sweep_tasks:{name}", seed=seed, options=options) for seed in range(count)]


@pytest.fixture(scope="module")
def serial(folder):
    """Return the jobs of the plan and the table of a serial run."""
    jobs = jobs_of(PLAN)
    ended, table = swept(jobs, folder / "serial.csv", root=folder)
    assert (ended.jobs, ended.done, ended.failed, ended.skipped) == (8, 8, 0, 0)
    return jobs, table


def test_a_serial_sweep_is_that_of_the_parts(serial, folder):
    jobs, table = serial
    assert table["key"] == [job.key for job in jobs] and table["axis.weights"][1:3] == ["plain", "auto"]
    steps = read_steps(folder / "run.log", range_max=20, limit=4)
    model = gs.LikelihoodFieldModel(gs.read_map(folder / "map.yaml"), steps[0].scan.scanner, beams=20, backend="numpy")
    pf = gs.ParticleFilter(model, particles=100, seed=1)
    start(pf, steps, everywhere=False)
    track = Track()
    assert len(list(follow(pf, steps, track))) == 4
    assert table["error_median"][3] == summary(track)["error_median"] and table["seed"][3] == 1
    assert max(table["error_median"]) < 1 and len(set(table["error_median"])) == 8


# Columns that differ between two runs of a job, besides those of times.
_VARIED = ("seconds", "cpu_seconds", "worker", "device", "attempts", "particle_beams_per_second")


def lasting(table: dict[str, list]) -> dict[str, list]:
    return {name: cells for name, cells in table.items() if name not in _VARIED and not name.startswith("ms_")}


def test_tables_of_all_executors_are_equal(serial, folder, processes, request):
    jobs, expected = serial
    executors = {"processes": processes}
    if find_spec("distributed") is not None:
        executors["cluster"] = request.getfixturevalue("cluster")
    for name, executor in executors.items():
        ended, table = swept(jobs, folder / f"{name}.csv", executor, root=folder)
        assert ended.done == 8 and len(set(table["worker"])) == 2
        assert lasting(table) == lasting(expected)


def test_score_and_fit_are_tasks(folder):
    common = dict(map="map.yaml", log="run.log")
    # Invalid odometry does not matter to scores.
    first, *rest = (folder / "run.log").read_text().splitlines()
    (folder / "odd.log").write_text("\n".join([first, "ODOM nan 0 0 0 0 0 0.5 robot 0.5", *rest]))
    scored: dict = dict(task="score", map="map.yaml", options={"particles": 50, "beams": 10, "range_max": 20})
    jobs = [
        Job(**scored, log="run.log", model="beam"),
        Job(**common, model="discrete", options={**SMALL, "training": {"every": 1}, "bins": 50}),
        *(Job(task="fit", **common, seed=seed, options={"block": 1, "range_max": 20}) for seed in (0, 1, 2)),
        Job(task="fit", map="map.yaml", log="absent.log"),
        Job(**scored, log="odd.log", model="beam"),
    ]
    _, table = swept(jobs, folder / "tasks.csv", root=folder)
    assert table["status"] == ["done"] * 5 + ["failed", "done"] and "absent.log" in table["error"][5]
    assert (
        table["rank_median"][0] == table["rank_median"][6] >= 1
        and table["error_median"][1] < 0.5
        and 0.01 < table["sigma_hit"][2] < 0.1
    )
    # A bootstrap resamples scans: its fit is close to the fit of all scans, and never equal.
    assert len(set(table["sigma_hit"][2:5])) == 3


def test_failures_are_rows_and_resuming_repeats_none_of_the_finished(tmp_path):
    path, jobs = tmp_path / "t.csv", made("failing", 4)
    ended, table = swept(jobs[:3], path)
    assert (ended.done, ended.failed) == (2, 1) and table["error"] == [None, "ValueError: a bad seed, 1", None]
    ended, table = swept(jobs, path, resume=True)
    assert (ended.done, ended.failed, ended.skipped) == (0, 1, 3) and table["seed"] == [0, 1, 2, 3]
    ended, table = swept(jobs, path, resume=True, retry_failed=True)
    assert (ended.done, ended.failed, ended.skipped) == (0, 2, 2) and len(table["seed"]) == 4
    with pytest.raises(FileExistsError, match="exists: resume it"):
        swept(jobs, path)


def test_what_a_worker_keeps_is_made_once(tmp_path):
    jobs = [Job(task="support.sweep_tasks:plain", map=name, seed=seed) for name in "ab" for seed in range(3)]
    assert swept(jobs, tmp_path / "t.csv")[1]["made"] == [True, False, False] * 2
    # The least recently used entry is evicted, and another sweep reads all files again, since they may have changed.
    more = [Job(task="support.sweep_tasks:plain", map=name, seed=9) for name in "bcdea"]
    more += [Job(task="support.sweep_tasks:plain", map=name, seed=8) for name in "eb"]
    assert swept(more, tmp_path / "more.csv")[1]["made"] == [True] * 5 + [False, True]


@pytest.mark.parametrize("name", ["processes", pytest.param("cluster", marks=dask)])
def test_a_killed_worker_loses_nothing(tmp_path, name, request):
    jobs = made("deadly", 6, folder=str(tmp_path))
    ended, table = swept(jobs, tmp_path / "t.csv", request.getfixturevalue(name))
    assert (tmp_path / "killed").exists() and ended.done == 6, table["error"]
    assert table["seed"] == list(range(6))
    assert table["value"] == [(seed + 1) / 3 for seed in range(6)]


@dask
def test_a_cluster_listens_on_the_loopback_only(cluster):
    assert cluster.address.startswith("tcp://127.0.0.1:") and cluster.slots == 2
    assert not cluster.dashboard or cluster.dashboard.startswith("http://127.0.0.1:")
    workers = cluster._workers().values()
    assert all(address.startswith("tcp://127.0.0.1:") for address in cluster._workers())
    assert {one["host"] for one in workers} == {"127.0.0.1"} and {one["nthreads"] for one in workers} == {1}


@dask
def test_maps_and_logs_are_sent_to_workers_once(folder, cluster, tmp_path):
    jobs = [Job(map="map.yaml", log="run.log", seed=seed, options={**SMALL, "limit": 2}) for seed in (0, 1)]
    contents = contents_of(jobs, folder)
    assert set(contents) == {"map.yaml", "run.log"} and isinstance(contents["run.log"], bytes)
    cluster.send(contents)
    # There is nothing at the root.
    ended, table = swept(jobs, tmp_path / "t.csv", cluster, root=tmp_path / "elsewhere")
    assert ended.done == 2, table["error"]


@dask
def test_the_command_sends_maps_and_logs_to_a_cluster(folder, cluster, tmp_path, capsys):
    plan = {"options": {**SMALL, "map": "map.yaml", "log": "run.log"}, "axes": {"seed": [7, 8]}}
    (folder / "plan.yaml").write_text(json.dumps(plan))
    table = tmp_path / "t.csv"
    assert cli.main(["sweep", str(folder / "plan.yaml"), "--table", str(table), "--dask", cluster.address]) == 0
    out, err = capsys.readouterr()
    assert "DONE: 2 of 2 jobs" in out and f"Dask at {cluster.address}, 2 slots" in err
    assert set(gs.sweep.read_table(table)["device"]) == {"numpy"}


@pytest.mark.long
def test_an_executor_that_is_shut_down_is_lost(tmp_path):
    executor = ProcessExecutor(1)
    executor.shutdown()
    with pytest.raises(SweepLost, match="must take jobs"):
        swept(made("plain", 1), tmp_path / "t.csv", executor)
    assert work(made("failing", 2)[1], str(tmp_path), "numpy").error == "ValueError: a bad seed, 1"
    assert isinstance(SerialExecutor().submit(int, "x").exception(), ValueError)
    for devices in (0, [], "numpy", None):
        with pytest.raises((TypeError, ValueError), match="devices: must be"):
            ProcessExecutor(devices)
