"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def required(feature: str) -> bool:
    """Whether GPUSENSE_REQUIRE, a comma-separated list, says that a feature must not be skipped."""
    return feature in [word.strip() for word in os.environ.get("GPUSENSE_REQUIRE", "").split(",")]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded data that GPUSENSE_DATA names; the test is skipped without it."""
    folder = os.environ.get("GPUSENSE_DATA", "")
    if folder and Path(folder).is_dir():
        return Path(folder)
    reason = f"GPUSENSE_DATA must name the folder of recorded data, got {folder!r}"
    if folder or required("data"):
        pytest.fail(reason)
    pytest.skip(reason)
