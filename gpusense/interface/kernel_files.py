"""The folder of the kernel sources, and the functions that read and import them.

The kernels are written in the top-level folder ``kernels/`` of a checkout and ship inside the wheel as
``gpusense/kernels``. Both layouts, and an editable install of a checkout, give the same module names
(``gpusense.kernels.warp.<name>``), so that caches keyed by module name and relative imports between kernel
modules do not depend on how the package was installed.
"""

import functools
import importlib
import importlib.util
import sys
import threading
from pathlib import Path
from types import ModuleType

_PACKAGE = "gpusense.kernels"
_LOCK = threading.Lock()


@functools.cache
def kernel_root() -> Path:
    """Return the folder that holds ``opencl/`` and ``warp/``."""
    package = Path(__file__).resolve().parents[1]
    candidates = (package / "kernels", package.parent / "kernels")
    for root in candidates:
        if (root / "__init__.py").is_file():
            return root
    places = " or ".join(f"'{root}'" for root in candidates)
    raise FileNotFoundError(f"the kernel sources must be in {places}; neither is there: install gpusense again")


@functools.cache
def opencl_source(name: str) -> str:
    """Return the text of ``opencl/<name>.cl``, such as ``"lanes/beam"``; each file is read once."""
    folder = kernel_root() / "opencl"
    try:
        return (folder / f"{name}.cl").read_text(encoding="utf-8")
    except FileNotFoundError:
        names = ", ".join(opencl_names())
        raise FileNotFoundError(f"name must be an OpenCL kernel file ({names}), got {name!r}") from None


def opencl_names() -> list[str]:
    """Return the names of all OpenCL kernel files as ``opencl_source`` takes them, sorted."""
    folder = kernel_root() / "opencl"
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.cl"))


@functools.cache
def has_opencl_source(name: str) -> bool:
    """Return whether there is a file ``opencl/<name>.cl``."""
    return (kernel_root() / "opencl" / f"{name}.cl").is_file()


def warp_source(name: str) -> str:
    """Return the text of ``warp/<name>.py``."""
    return (kernel_root() / "warp" / f"{name}.py").read_text(encoding="utf-8")


def warp_files() -> ModuleType:
    """Import ``warp/prelude.py``, which loads the other files for sets of flags."""
    _register_package()
    return importlib.import_module(f"{_PACKAGE}.warp.prelude")


def _register_package() -> None:
    """Import the kernel folder as the package ``gpusense.kernels``, wherever it lies."""
    with _LOCK:
        if _PACKAGE in sys.modules:
            return
        root = kernel_root()
        spec = importlib.util.spec_from_file_location(
            _PACKAGE, root / "__init__.py", submodule_search_locations=[str(root)]
        )
        if spec is None or spec.loader is None:
            raise ImportError(f"cannot import '{root / '__init__.py'}'", name=_PACKAGE)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        sys.modules[_PACKAGE] = module
        parent, _, child = _PACKAGE.rpartition(".")
        setattr(sys.modules[parent], child, module)
