"""Files about the project and pages with lists of names agree with the code."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from types import SimpleNamespace

import pytest
import yaml
from packaging.requirements import Requirement
from support.paths import ROOT

import gpusense as gs
from gpusense.commands.cli import COMMANDS
from gpusense.localization import nav2, nav2_file

SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = SETTINGS["project"]
MIGRATION = (ROOT / "docs" / "migration.md").read_text(encoding="utf-8")


def names(requirements):
    """Return the names of the packages of requirements."""
    return {Requirement(each).name for each in requirements}


def code_spans(text):
    """Return the words of the spans of code in the first column of tables."""
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("|")]
    return {word for cell in cells for span in re.findall(r"`([^`]+)`", cell) for word in re.findall(r"[\w.]+", span)}


def test_citation_has_the_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == gs.__version__ and citation["license"] == PROJECT["license"]


def test_getting_started_lists_every_command():
    page = (ROOT / "docs" / "getting-started.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `gpusense ([\w-]+)", page, re.MULTILINE)
    assert sorted(listed) == sorted(COMMANDS)


def test_the_picture_of_the_rooms_has_their_order():
    picture = (ROOT / "docs" / "img" / "architecture.svg").read_text(encoding="utf-8")
    shown = re.findall(r'class="b"/><text [^>]*class="t">(\w+)<', picture)
    layers = SETTINGS["tool"]["importlinter"]["contracts"][0]["layers"]
    assert [f"gpusense.{room}" for room in ("__main__", *shown)] == layers


def test_the_page_of_dependencies_has_each():
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8").split("## Dependencies and their licences")[1]
    first, second = page.split("| extra |")
    listed = {line.split("|")[1].strip() for line in first.splitlines() if re.match(r"\| [a-zA-Z]", line)} - {"package"}
    assert listed == names(PROJECT["dependencies"])
    for extra in ("bench", "docs", "intel", "rerun", "ros2", "sweep"):
        row = next(line for line in second.splitlines() if line.startswith(f"| `{extra}` |"))
        assert names(PROJECT["optional-dependencies"][extra]) <= set(re.findall(r"[\w.-]+", row)), extra


# Parameters of nav2_amcl's node that from_nav2 does not know.
IGNORED = {
    "always_reset_initial_pose", "beam_skip_distance", "beam_skip_error_threshold", "first_map_only", "initial_pose.z",
    "save_pose_rate", "freespace_downsampling", "random_seed", "use_sim_time", "allow_parameter_qos_overrides",
    "initialize_at_saved_pose", "saved_pose_filepath",
}  # fmt: skip


def test_migration_names_every_parameter_of_nav2_amcl():
    part = MIGRATION[MIGRATION.index("## nav2_amcl") : MIGRATION.index("## Beluga")]
    known = set(nav2.DEFAULTS) | {name for name in nav2_file.START_NAMES if "covariance" not in name}
    alphas = {"alpha2", "alpha3"}  # between alpha1 and alpha4
    assert code_spans(part) == (known | IGNORED) - alphas
    assert gs.compat.from_nav2({"amcl": {"ros__parameters": dict.fromkeys(IGNORED, 1.0)}}).ignored == tuple(
        sorted(IGNORED)
    )


def test_migration_names_every_method_of_range_libc():
    part = MIGRATION[MIGRATION.index("## range_libc") : MIGRATION.index("## MRPT")]
    methods = """calc_range calc_range_many calc_range_repeat_angles calc_range_many_radial_optimized set_sensor_model
        eval_sensor_model calc_range_repeat_angles_eval_sensor_model saveTrace prune isOccupied width height save error
        PyOMap PyBresenhamsLine PyRayMarching PyRayMarchingGPU PyCDDTCast PyGiantLUTCast PyNull"""
    words = {piece for word in code_spans(part) for piece in word.split(".")}
    assert set(methods.split()) <= words


@pytest.mark.parametrize(
    "path", [*(ROOT / ".github").rglob("*.yml"), ROOT / ".pre-commit-config.yaml"], ids=lambda p: p.name
)
def test_templates_are_yaml(path):
    if not path.is_file():
        pytest.skip("only the checkout has it")
    assert isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict)


# Largest sizes [bytes]: twice the first release's.
SIZES = {".whl": 2.6e6, ".gz": 10.5e6}


@pytest.mark.slow
def test_what_is_published_is_sound_and_small(tmp_path):
    pytest.importorskip("twine")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path, ROOT]
    subprocess.run(build, cwd=tmp_path, check=True, capture_output=True)
    files = sorted(tmp_path.iterdir())
    assert {file.suffix for file in files} == set(SIZES)
    for file in files:
        assert file.stat().st_size < SIZES[file.suffix], file.name
    check = [sys.executable, "-m", "twine", "check", "--strict", *files]
    done = subprocess.run(check, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_a_worker_for_each_core_and_none_for_a_file(pytestconfig: pytest.Config) -> None:
    """Several files or a folder get workers without threads of linear algebra; tests of one file stay in a process."""

    def workers(*arguments: str) -> int:
        count: int = pytestconfig.hook.pytest_xdist_auto_num_workers(config=SimpleNamespace(args=arguments))
        return count

    assert (
        workers(__file__)
        == workers(f"{__file__}::test_a")
        == workers(f"{__file__}::test_a", f"{__file__}::test_b")
        == 0
    )
    assert workers("tests") == workers(__file__, str(ROOT / "tests" / "conftest.py")) >= 1
    assert os.environ["OPENBLAS_NUM_THREADS"] != ""
