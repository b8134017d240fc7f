"""Casters: methods for expected ranges, for ``RayCaster(caster=...)`` and ``BeamModel(caster=...)``."""

from gpusense.tables.casters import *  # noqa: F403
from gpusense.tables.casters import __all__ as __all__
