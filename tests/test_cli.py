"""The command line: help, exit codes, one-line errors, JSON, and the demonstration."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import gpusense
from gpusense import cli
from gpusense.commands import _common, demo, devices

SMALL = ["demo", "--particles", "400", "--beams", "20"]
# What a model in float32 may differ from the float64 reference on 60 beams at most [nats], on its own rounded inputs.
DEMO_TOLERANCE = 1e-2


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
    """Make ``gpusense devices`` raise."""

    def install(error: BaseException) -> None:
        def run(args: object) -> int:
            raise error

        monkeypatch.setattr(devices, "run", run)

    return install


ROOT = Path(__file__).resolve().parents[1]


def script(code: str, *, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run Python code that imports the gpusense under test."""
    prologue = f"import sys; sys.path.insert(0, {str(Path(gpusense.__file__).parents[1])!r})\n"
    return subprocess.run([sys.executable, "-c", prologue + code], cwd=cwd, capture_output=True, text=True, check=False)


def error_of(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that a bad call prints, without the program's name."""
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("gpusense: error: ") and err.endswith("\n") and err.count("\n") == 1
    return err.removeprefix("gpusense: error: ").removesuffix("\n")


@pytest.mark.parametrize("argv", [[], ["--help"]])
def test_top_level_help_lists_every_command(argv, capsys):
    assert cli.main(argv) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for name in cli.COMMANDS:
        assert f"\n    {name} " in out


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_command_help_has_an_example(name, capsys):
    assert cli.main([name, "--help"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.startswith(f"usage: gpusense {name} ")
    assert "example" in out and f"  gpusense {name}" in out
    assert "--json" in out


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_command_modules_keep_the_contract(name):
    module = importlib.import_module(f"gpusense.commands.{name}")
    assert name == module.NAME
    assert module.HELP.endswith(".") and "\n" not in module.HELP


def test_help_loads_no_backend_and_no_drawing(tmp_path):
    done = script(
        "from gpusense.cli import main; code = main(['--help'])\n"
        "heavy = {'matplotlib', 'rich', 'pyopencl', 'warp', 'scipy', 'PIL', 'yaml'} & set(sys.modules)\n"
        "print(code, sorted(heavy))",
        cwd=tmp_path,
    )
    assert done.stdout.splitlines()[-1] == "0 []", done.stderr


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"gpusense {gpusense.__version__}\n"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["devices", "--jsn"], "unrecognized arguments: --jsn"),
        ([*SMALL, "--js"], "unrecognized arguments: --js"),
        (["demo", "--particles", "-5"], "argument --particles: must be an integer from 1 to 100000000, got -5"),
        (["demo", "--particles", "1e3"], "argument --particles: must be an integer from 1 to 100000000, got '1e3'"),
        (["demo", "--beams", "181"], "argument --beams: must be an integer from 1 to 180, got 181"),
        (["demo", "--seed", "-1"], "argument --seed: must be an integer >= 0, got -1"),
        (["demo", "--output", "demo.gif"], "argument --output: must end in .png or .pdf or .svg, got 'demo.gif'"),
        (["demo", "--particles"], "argument --particles: expected one argument"),
        (
            [*SMALL, "--no-plot", "--backend", "cuda"],
            "backend: must be 'auto', 'numpy', 'opencl', 'opencl:<name or P:D>', 'warp:cpu' or 'warp:cuda:<n>', "
            "got 'cuda'",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(argv, message, capsys):
    assert error_of(argv, capsys) == message


def test_unknown_command_names_the_choices(capsys):
    message = error_of(["bogus"], capsys)
    assert message.startswith("argument COMMAND: invalid choice: 'bogus'")
    assert all(name in message for name in cli.COMMANDS)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("grid: must be\n  a map,\tgot 3"), "grid: must be a map, got 3"),
        (TypeError("poses: must hold real numbers"), "poses: must hold real numbers"),
        (MemoryError(), "out of memory"),
        (FileNotFoundError(2, "No such file or directory", "map.yaml"), "map.yaml: No such file or directory"),
        (OSError("device lost"), "device lost"),
    ],
)
def test_exceptions_of_the_library_are_one_line(error, message, broken, capsys):
    broken(error)
    assert error_of(["devices"], capsys) == message


def test_exceptions_pass_where_the_environment_asks_for_it(broken, monkeypatch):
    broken(ValueError("why"))
    monkeypatch.setenv(cli.TRACEBACK, "1")
    with pytest.raises(ValueError, match="why"):
        cli.main(["devices"])


def test_keyboard_interrupt_is_130(broken, capsys):
    broken(KeyboardInterrupt())
    assert cli.main(["devices"]) == 130
    assert capsys.readouterr() == ("", "gpusense: interrupted\n")


def test_broken_pipe_is_silent(broken, capsys):
    broken(BrokenPipeError())
    assert cli.main(["devices"]) == 141
    assert capsys.readouterr() == ("", "")


@pytest.mark.skipif(sys.platform == "win32", reason="pipes break with a signal's error on POSIX only")
def test_reader_that_went_away_leaves_no_traceback(tmp_path):
    code = (
        "import os; from gpusense.cli import main\n"
        "read, write = os.pipe(); os.close(read); os.dup2(write, 1)\n"
        "sys.exit(main(['devices', '--json']))"
    )
    done = script(code, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_full_disk_is_one_line(tmp_path):
    code = "from gpusense.cli import main; import os; os.dup2(os.open('/dev/full', os.O_WRONLY), 1); "
    code += "sys.exit(main(['devices']))"
    done = script(code, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (2, "gpusense: error: No space left on device\n")


def test_module_is_the_command(tmp_path):
    code = "import runpy; sys.argv = ['gpusense', 'demo', '--seed', 'x']; "
    code += "runpy.run_module('gpusense', run_name='__main__')"
    done = script(code, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "gpusense: error: argument --seed: must be an integer >= 0, got 'x'\n"


def test_devices_as_json(capsys):
    assert cli.main(["devices", "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    report = json.loads(out)
    marked = [device["selection"] for device in report["devices"] if device["auto"]]
    assert marked == [report["auto"]]
    for device in report["devices"]:
        assert device["available"] == bool(device["selection"]) == (device["reason"] == "")
    assert {"gpusense", "platform", "processor", "processors", "python", "numpy"} == set(report["machine"])


def test_devices_as_a_table(capsys):
    assert cli.main(["devices"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["selection", "backend", "kind", "name", "status"]
    assert any(line.split()[:2] == ["numpy", "numpy"] or line.split()[:3] == ["*", "numpy", "numpy"] for line in lines)
    assert sum(line.startswith("*  ") for line in lines) == 1


def test_devices_survive_a_broken_auto(monkeypatch, capsys):
    def fail(selection: str) -> object:
        raise RuntimeError("driver lost")

    monkeypatch.setattr("gpusense.backends.get_backend", fail)
    assert cli.main(["devices"]) == 0
    assert "'auto' does not work: RuntimeError: driver lost" in capsys.readouterr().out


def test_demo_numbers_agree(backend, capsys):
    assert cli.main([*SMALL, "--backend", "numpy", "--backend", backend, "--no-plot", "--json"]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert err == ""
    assert (report["failures"], report["particles"], report["picture"]) == ([], 400, None)
    assert len(report["results"]) == 2 * len({"numpy", backend})
    for model in ("beam model", "likelihood field"):
        own = [result for result in report["results"] if result["model"] == model]
        for result in own:
            assert result["largest_error"] <= DEMO_TOLERANCE
            assert result["best_pose"] == own[0]["best_pose"]
            assert result["log_p_of_true_pose"] == pytest.approx(own[0]["log_p_of_true_pose"], abs=DEMO_TOLERANCE)
            assert 1 <= result["rank_of_true_pose"] <= 401
            assert result["first_call_s"] > 0 and result["particle_beams_per_s"] > 0
            assert 0 < result["beams_evaluated"] <= 20
            assert "float32" in result["explain"]


def test_demo_picture(needs, tmp_path, monkeypatch, capsys):
    from PIL import Image

    monkeypatch.setattr(demo, "LATTICE", 0.25)
    picture = tmp_path / "demo.png"
    argv = [*SMALL, "--backend", "numpy", "--backend", needs("opencl"), "--output", str(picture), "--json"]
    assert cli.main(argv) == 0
    assert json.loads(capsys.readouterr().out)["picture"] == str(picture)
    with Image.open(picture) as image:
        assert image.size == (2250, 1470)
        pixels = np.asarray(image.convert("RGB")).astype(np.int32) @ [1 << 16, 1 << 8, 1]
    assert len(np.unique(pixels)) > 1000
    # Each of the four maps is drawn: neither one colour nor the same as another.
    parts = [half for row in np.array_split(pixels, 2) for half in np.array_split(row, 2, axis=1)]
    assert len({part.tobytes() for part in parts}) == 4
    assert all(len(np.unique(part)) > 100 for part in parts)
    assert [path.name for path in tmp_path.iterdir()] == ["demo.png"]


def test_demo_as_text(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*SMALL, "--backend", "numpy", "--no-plot"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "particles  400: half over all free cells" in out
    rows = [line for line in out.splitlines() if line.startswith("numpy ")]
    assert len(rows) == 2
    assert out.count("What was left out and why: ") == 2
    assert list(tmp_path.iterdir()) == []


def test_demo_is_the_same_for_the_same_seed(capsys):
    reports = []
    for seed in ("3", "3", "4"):
        assert cli.main([*SMALL, "--seed", seed, "--backend", "numpy", "--no-plot", "--json"]) == 0
        reports.append(json.loads(capsys.readouterr().out))
    same = [(report["true_pose"], report["scan"], report["results"][0]["best_log_p"]) for report in reports]
    assert same[0] == same[1] != same[2]


@pytest.mark.parametrize("name", ["missing/demo.png", "folder.png"])
def test_demo_refuses_an_output_that_cannot_be_written(name, tmp_path, capsys):
    (tmp_path / "folder.png").mkdir()
    message = error_of(["demo", "--output", str(tmp_path / name)], capsys)
    assert message.startswith(f"argument --output: must be a file that can be written, got '{tmp_path / name}': ")
    assert [path.name for path in tmp_path.rglob("*")] == ["folder.png"]


def test_demo_checks_its_default_output_before_it_works(tmp_path, monkeypatch, capsys):
    (tmp_path / "gpusense-demo.png").mkdir()
    monkeypatch.chdir(tmp_path)
    assert error_of(SMALL, capsys) == "gpusense-demo.png: must be a regular file, got another kind"


def test_demo_goes_on_without_a_device_that_nobody_asked_for(needs, monkeypatch, capsys):
    needs("opencl")
    score = demo.score

    def fail(scene, name, backend, reference):
        if backend.info.backend == "opencl":
            raise RuntimeError("the compiler crashed")
        return score(scene, name, backend, reference)

    monkeypatch.setattr(demo, "score", fail)
    assert cli.main([*SMALL, "--no-plot", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert {result["backend"] for result in report["results"]} >= {"numpy"}
    assert any("the compiler crashed" in failure for failure in report["failures"])


def test_demo_draws_without_pyplot(tmp_path):
    done = script(
        "from gpusense.commands import demo; demo.LATTICE = 0.5\n"
        f"from gpusense.cli import main; code = main({[*SMALL, '--backend', 'numpy', '--output', 'demo.svg']})\n"
        "print(code, 'matplotlib.pyplot' in sys.modules)",
        cwd=tmp_path,
    )
    assert done.stdout.splitlines()[-1] == "0 False", done.stderr
    assert "</svg>" in (tmp_path / "demo.svg").read_text(encoding="utf-8")[-20:]


def test_write_whole_replaces_or_leaves_as_it_was(tmp_path):
    path = tmp_path / "report.csv"
    _common.write_whole(path, lambda stream: stream.write(b"first"))
    assert path.read_bytes() == b"first"

    def fail(stream):
        stream.write(b"half")
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        _common.write_whole(path, fail)
    assert path.read_bytes() == b"first"
    _common.write_whole(path, lambda stream: stream.write(b"second"))
    assert path.read_bytes() == b"second"
    assert [file.name for file in tmp_path.iterdir()] == ["report.csv"]


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need a privilege on Windows")
def test_write_whole_follows_a_link(tmp_path):
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_bytes(b"old")
    link.symlink_to(target)
    _common.write_whole(link, lambda stream: stream.write(b"new"))
    assert link.is_symlink() and target.read_bytes() == b"new"


def test_write_whole_refuses_what_is_no_regular_file(tmp_path):
    with pytest.raises(ValueError, match="must be a regular file"):
        _common.write_whole(tmp_path, lambda stream: stream.write(b""))


def test_json_has_no_numbers_that_json_does_not_know(capsys):
    values = {"a": np.float32(np.inf), "b": [float("nan"), 1], "c": np.array([1.5, -np.inf]), "d": Path("x"), "e": None}
    _common.print_json(values)
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1], "c": [1.5, None], "d": "x", "e": None}


def test_plain_table_is_aligned():
    lines = _common.table_lines(["name", "s"], [["numpy", "1.25"], ["a", "10.50"]], right=["s"])
    assert lines == ["name       s", "-----  -----", "numpy   1.25", "a      10.50"]


def test_terminal_gets_a_table_and_a_progress_bar(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    _common.print_table(["name", "s"], [["[bold]numpy", "1.25"]], right=["s"])
    with _common.progress(2) as step:
        step("one")
        step("two")
    out, err = capsys.readouterr()
    assert "[bold]numpy" in out and "1.25" in out
    assert "one" not in out and err != ""


def test_example_finds_the_pose(tmp_path):
    example = ROOT / "examples" / "score_scan.py"
    done = script(f"import runpy; runpy.run_path({str(example)!r})", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("the best pose is [2.5 2.  0.4] with log P(z | x, m) = ")
    assert lines[1].startswith("beam model, float32, ")
