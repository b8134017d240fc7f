"""Casters: methods for expected ranges, for ``RayCaster(caster=...)`` and ``BeamModel(caster=...)``."""

from gpusense.tables.casters import CASTERS, Bresenham, Caster, Cddt, Dda, Exact, Lookup, March

__all__ = ["CASTERS", "Bresenham", "Caster", "Cddt", "Dda", "Exact", "Lookup", "March"]
