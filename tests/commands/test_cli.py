"""The command line: help, exit codes, one-line errors, and the devices."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.command_line import SMALL, error_of, script
from support.paths import ROOT
from support.selection import NO_SELECTION

import gpusense
from gpusense.commands import cli, devices


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
    """Make ``gpusense devices`` raise."""

    def install(error: BaseException) -> None:
        def run(args: object) -> int:
            raise error

        monkeypatch.setattr(devices, "run", run)

    return install


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
    assert "--json" in out or name == "ros"  # a node has no result


def test_help_executes_no_model_and_opens_no_device(tmp_path):
    done = script(
        "from gpusense.commands import cli; cli._build(cli.COMMANDS); print(*(name for name, module in "
        "sys.modules.items() if type(module).__name__ != '_LazyModule'))", cwd=tmp_path,
    )  # fmt: skip
    executed = set(done.stdout.split())
    assert {f"gpusense.commands.{name.replace('-', '_')}" for name in cli.COMMANDS} <= executed, done.stderr
    rooms = ("models.scan.model", "backends.base", "matching.match", "localization.filter", "logs.records",
             "plots.drawing", "evaluation.tracking", "sweeps.job")  # fmt: skip
    libraries = {"matplotlib", "rich", "pyopencl", "warp", "scipy", "PIL", "yaml"}
    assert not executed & (libraries | {f"gpusense.{name}" for name in rooms})


def test_options_of_a_page_belong_to_a_command_that_it_names():
    (group,) = cli._build(cli.COMMANDS)._subparsers._group_actions
    commands = group.choices
    options = {
        name: {text for one in parser._actions for text in one.option_strings} for name, parser in commands.items()
    }
    every, gone = set().union(*options.values()), []
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        known = set().union(*(options[name] for name in options if re.search(rf"gpusense {name}\b", text)))
        gone += [(page.name, one) for one in re.findall(r"`(--[a-z][a-z-]*)", text) if one in every - known]
    assert gone == []


def test_each_command_has_one_line_of_help_on_80_columns():
    assert all(text.endswith(".") and len(text) <= 58 for text in cli.COMMANDS.values())


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"gpusense {gpusense.__version__}\n"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["devices", "--jsn"], "unrecognized arguments: --jsn; did you mean '--json'?"),
        ([*SMALL, "--nothing-like-it"], "unrecognized arguments: --nothing-like-it"),
        (["match", "--log", "run.log", "--kinds", "x"], "unrecognized arguments: --kinds x"),
        (["demo", "--particles", "1e3"], "argument --particles: must be an integer from 1 to 100000000, got '1e3'"),
        (["demo", "--output", "demo.gif"], "argument --output: must end in .png or .pdf or .svg, got 'demo.gif'"),
        (
            ["simulate", "--map", "m.yaml", "--log-out", "./m.yaml"],
            "argument --log-out: must be another file than that of --map, got both",
        ),
        ([*SMALL, "--no-plot", "--backend", "vulkan"], NO_SELECTION("vulkan")),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(argv, message, capsys):
    assert error_of(argv, capsys) == message


def test_unknown_command_names_the_choices(capsys):
    message = error_of(["bogus"], capsys)
    assert message.startswith("argument COMMAND: invalid choice: 'bogus'")
    assert all(name in message for name in cli.COMMANDS)
    assert "did you mean" not in message
    assert error_of(["localizze"], capsys).endswith("; did you mean 'localize'?")
    assert error_of(["fit", "--method", "graddient"], capsys).endswith("; did you mean 'gradient'?")


def test_localise_is_localize(capsys):
    assert cli.main(["localise", "--help"]) == 0
    assert capsys.readouterr().out.startswith("usage: gpusense localize ")


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
        "import os; from gpusense.commands.cli import main\n"
        "read, write = os.pipe(); os.close(read); os.dup2(write, 1)\n"
        "sys.exit(main(['devices', '--json']))"
    )
    done = script(code, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_full_disk_is_one_line(tmp_path):
    code = "from gpusense.commands.cli import main; import os; os.dup2(os.open('/dev/full', os.O_WRONLY), 1); "
    code += "sys.exit(main(['devices']))"
    done = script(code, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (2, "gpusense: error: No space left on device\n")


def test_module_is_the_command(tmp_path):
    code = "import runpy; sys.argv = ['gpusense', 'demo', '--seed', 'x']; "
    code += "runpy.run_module('gpusense', run_name='__main__')"
    done = script(code, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "gpusense: error: argument --seed: must be an integer >= 0, got 'x'\n"


def test_no_garbage_is_collected_at_the_end_of_a_command(tmp_path):
    code = "import atexit, gc; atexit.register(lambda: print('frozen:', gc.get_freeze_count() > 0)); "
    code += "sys.argv = ['gpusense', '--version']; from gpusense.commands.cli import main; main()"
    assert script(code, cwd=tmp_path).stdout.endswith("frozen: True\n")


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
    assert re.fullmatch(r"'auto' is \S+: .+, a [CG]PU", lines[0])
    assert lines[2].split() == ["selection", "kind", "name", "driver", "status"]
    assert any(line.split()[:2] == ["numpy", "cpu"] for line in lines)


def test_devices_survive_a_broken_auto(monkeypatch, capsys):
    def fail(selection: str) -> object:
        raise RuntimeError("driver lost")

    monkeypatch.setattr("gpusense.backends.get_backend", fail)
    assert cli.main(["devices"]) == 0
    assert "'auto' does not work: RuntimeError: driver lost" in capsys.readouterr().out


def test_options_are_completed(tmp_path):
    pytest.importorskip("argcomplete")
    line, out = "gpusense localize --ani", tmp_path / "words"
    variables = dict(_ARGCOMPLETE="1", COMP_LINE=line, COMP_POINT=str(len(line)), _ARGCOMPLETE_STDOUT_FILENAME=str(out))
    code = "from gpusense.commands.cli import main; main([])"
    subprocess.run([sys.executable, "-c", code], env=os.environ | variables, check=True)
    assert out.read_text().split() == ["--animate"]
