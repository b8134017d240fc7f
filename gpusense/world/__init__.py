"""Plain data about the world: maps, scanners, parameters, frames; no device."""
