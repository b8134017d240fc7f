"""The package finds its kernels in every kind of installation, and importing it stays cheap."""

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest
from support.paths import ROOT

import gpusense
from gpusense.interface.kernel_files import opencl_source

COPIED = ("bench", "docs", "examples", "gpusense", "kernels", "tests")

# Layouts built or installed from a copy of the checkout.
BUILT = ("wheel", "sdist", "editable")

needs_warp = pytest.mark.skipif(find_spec("warp") is None, reason="Warp has no wheel for this platform")

# Reports where the package and the kernels were found, and every OpenCL source as it was read.
FIND = """
import json
import sys
import gpusense
from gpusense.interface.kernel_files import kernel_root, opencl_names, opencl_source

root = kernel_root()
sources = {name: opencl_source(name) for name in opencl_names()}
print(json.dumps({"package": gpusense.__file__, "root": str(root), "path": sys.path, "opencl": sources}))
"""

# Imports every Warp kernel file and reports the name and the file of each module.
IMPORT = """
import json
import warp
from gpusense.interface.kernel_files import kernel_root, warp_files

names = [path.stem for path in kernel_root().glob("warp/*.py") if path.stem not in ("__init__", "prelude")]
modules = {name: warp_files().file_of(name) for name in names}
report = {name: [module.__name__, module.__file__] for name, module in modules.items()}
print(json.dumps({"modules": report, "library": warp.__file__}))
"""


@dataclass(frozen=True)
class Layout:
    """A place of the package on a disk, with a Python that imports it from there."""

    package: Path
    kernels: Path
    search_path: Path | None
    python: Path

    def run(self, script: str, *, cwd: Path) -> str:
        """Run a script and return the last line that it prints."""
        environment = {"WARP_CACHE_PATH": str(cwd / "warp-cache")}
        if self.search_path is not None:
            environment["PYTHONPATH"] = str(self.search_path)
        return run([self.python, "-c", script], cwd=cwd, environment=environment).splitlines()[-1]


def run(arguments: list[str | Path], *, cwd: Path, environment: dict[str, str] | None = None) -> str:
    """Run a command with a clean Python environment and return its standard output."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [os.fspath(argument) for argument in arguments],
        cwd=cwd,
        env=variables | {"PYTHONSAFEPATH": "1"} | (environment or {}),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{arguments} failed:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of the files under a folder by relative name, without caches."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy the checkout to a folder with a space in its name; builds write nothing into the real one."""
    copy = tmp_path_factory.mktemp("check out") / "gpu sense"
    copy.mkdir()
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, copy)
        elif path.name in COPIED:
            shutil.copytree(path, copy / path.name, ignore=shutil.ignore_patterns("__pycache__"))
    return copy


@pytest.fixture(scope="module")
def sdist(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the source distribution without a network and unpack it."""
    folder = tmp_path_factory.mktemp("sdist")
    run([sys.executable, "-m", "build", "--no-isolation", "--sdist", "--outdir", folder, checkout], cwd=folder)
    with tarfile.open(next(folder.glob("*.tar.gz"))) as archive:
        archive.extractall(folder, filter="data")
    return next(path for path in folder.iterdir() if path.is_dir())


def unpacked_wheel(source: Path, folder: Path) -> Path:
    """Build the wheel of a source folder, without a network, and return the folder that it unpacks to."""
    run([sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", folder, source], cwd=folder)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


@pytest.fixture(scope="module")
def wheel(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from the checkout and unpack it."""
    return unpacked_wheel(checkout, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def wheel_of_sdist(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from the source distribution and unpack it."""
    return unpacked_wheel(sdist, tmp_path_factory.mktemp("wheel-of-sdist"))


@pytest.fixture(scope="module")
def editable_python(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the interpreter of a new virtual environment with the copied checkout installed by pip -e."""
    environment = tmp_path_factory.mktemp("editable") / "venv"
    run([sys.executable, "-m", "venv", "--without-pip", environment], cwd=environment.parent)
    scripts = environment / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / ("python.exe" if os.name == "nt" else "python")
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = run([python, "-c", where], cwd=environment).strip()
    # Use this environment's libraries; the file's name sorts it after the editable install's.
    paths = dict.fromkeys([sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    Path(site, "zz_borrowed.pth").write_text("\n".join(paths), encoding="utf-8")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--no-index", "--no-deps"]
    options = ["--ignore-installed", "--no-build-isolation", "--editable", checkout]
    run([*pip, *options], cwd=environment)
    return python


@pytest.fixture(params=[*(pytest.param(name, marks=pytest.mark.slow) for name in BUILT), "checkout"])
def layout(request: pytest.FixtureRequest, checkout: Path) -> Layout:
    """Return each layout of the package on a disk in turn."""
    if request.param == "editable":
        python: Path = request.getfixturevalue("editable_python")
        return Layout(checkout / "gpusense", checkout / "kernels", search_path=None, python=python)
    folder: Path = request.getfixturevalue(request.param)
    package = folder / "gpusense"
    kernels = package / "kernels" if request.param == "wheel" else folder / "kernels"
    return Layout(package, kernels, search_path=folder, python=Path(sys.executable))


@pytest.mark.slow
def test_wheel_holds_the_package_with_the_kernels_and_nothing_else(wheel: Path, checkout: Path) -> None:
    kernels = {f"kernels/{name}": data for name, data in contents(checkout / "kernels").items()}
    assert contents(wheel / "gpusense") == contents(checkout / "gpusense") | kernels
    assert [path.suffix for path in sorted(wheel.iterdir())] == ["", ".dist-info"]


@pytest.mark.slow
def test_sdist_holds_the_sources_and_the_tests(sdist: Path, checkout: Path) -> None:
    for folder in ("gpusense", "kernels", "tests"):
        assert contents(sdist / folder) == contents(checkout / folder), folder


@pytest.mark.slow
def test_wheel_of_the_sdist_is_the_wheel_of_the_checkout(wheel: Path, wheel_of_sdist: Path) -> None:
    assert contents(wheel_of_sdist) == contents(wheel)


def test_kernels_are_found(layout: Layout, checkout: Path, tmp_path: Path) -> None:
    report = json.loads(layout.run(FIND, cwd=tmp_path))
    assert Path(report["package"]).parent == layout.package
    assert Path(report["root"]) == layout.kernels
    assert str(layout.kernels) not in report["path"]
    sources = contents(checkout / "kernels" / "opencl")
    assert report["opencl"] == {name.removesuffix(".cl"): text.decode() for name, text in sources.items()}
    assert any(name.startswith("lanes/") for name in sources)


@pytest.mark.long
@needs_warp
def test_warp_kernels_are_imported_under_one_name(layout: Layout, checkout: Path, tmp_path: Path) -> None:
    report = json.loads(layout.run(IMPORT, cwd=tmp_path))
    names = [
        path.stem for path in (checkout / "kernels" / "warp").glob("*.py") if path.stem not in ("__init__", "prelude")
    ]
    folder = layout.kernels / "warp"
    assert report["modules"] == {name: [f"gpusense.kernels.warp.{name}", str(folder / f"{name}.py")] for name in names}
    assert Path(report["library"]).parent != folder


def test_an_unknown_kernel_is_named() -> None:
    with pytest.raises(FileNotFoundError, match=r"name must be an OpenCL kernel file \(.+\), got 'no_such'"):
        opencl_source("no_such")


def test_importing_gpusense_loads_no_backend(layout: Layout, tmp_path: Path) -> None:
    heavy = ("PIL", "matplotlib", "pyopencl", "rich", "rosbags", "scipy", "warp", "yaml")
    script = f"import sys, gpusense; print([name for name in {heavy!r} if name in sys.modules])"
    assert layout.run(script, cwd=tmp_path) == "[]"


@pytest.mark.skipif(not sys.flags.safe_path, reason="without python -P the checkout may be what is imported")
def test_the_installed_package_is_under_test() -> None:
    distribution = importlib.metadata.distribution("gpusense")
    origin = json.loads(distribution.read_text("direct_url.json") or "{}")
    if origin.get("dir_info", {}).get("editable"):
        pytest.skip("an editable install is the checkout")
    installed = Path(str(distribution.locate_file("gpusense/__init__.py")))
    assert Path(gpusense.__file__).resolve() == installed.resolve()
