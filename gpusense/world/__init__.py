"""Plain data about the world and its sensors: grid, map files, scanner, parameters, landmark maps, frames, windows."""
