"""HTML of maps, models, fits, estimates, matches and fixes in notebooks: well-formed, escaped and small."""

from __future__ import annotations

import io
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

import gpusense as gs
from gpusense._util.html import LONGEST, card, grey_png
from gpusense.world.grid import WIDEST, thumbnail

EMPTY = {"br", "img"}
SCANNER = gs.Scanner(np.radians(np.arange(-120, 121, 3)), range_max=8.0)


class Checked(HTMLParser):
    """A parser that collects the cells of tables, and checks that tags are closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.cells, self.tags = [], [], set()
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.cells.append(data)


@pytest.fixture(scope="module")
def things():
    """Return an object of each kind, by name."""
    grid = gs.worlds.building(seed=4, size=(14.0, 12.0))
    run = gs.worlds.simulate_run(grid, SCANNER, scans=3)
    drive = gs.worlds.simulate_run(grid, gs.Scanner([0.0], 8.0), scans=60)
    beam = gs.BeamModel(grid, SCANNER, backend="numpy")
    field = gs.LikelihoodFieldModel(grid, SCANNER, backend="numpy", beams=20)
    landmarks = gs.LandmarkMap([(5, 0), (0, 5)])
    expected = beam.expected_ranges(run.poses)
    features = [(5.1, 0.0), (4.9, 0.0), (5.0, 1.6), (5.1, 1.5)]
    match = gs.match_scan(run.scans[0], run.scans[1], SCANNER, backend="numpy")
    pf = gs.ParticleFilter(field, particles=200, seed=0)
    pf.initialize(mean=run.poses[0], covariance=np.diag([0.1, 0.1, 0.1]))
    pf.correct(run.scans[0])
    return {
        "OccupancyGrid": grid,
        "BeamModel": beam,
        "LikelihoodFieldModel": field,
        "LandmarkModel": gs.LandmarkModel(landmarks, backend="numpy"),
        "HeadingModel": gs.HeadingModel(backend="numpy"),
        "BeamFit": gs.fit_beam_parameters(run.scans, expected, 8.0, backend="numpy"),
        "IncidenceFit": gs.fit_incidence_parameters(
            run.scans, expected, beam.incidence(run.poses), 8.0, bins=2, backend="numpy"
        ),
        "PointFit": gs.fit_heading_parameters(run.poses, run.poses[:, 2] + (0.1, 0.0, -0.1)),
        "LandmarkFit": gs.fit_landmark_parameters(
            [(0, 0, 0)] * 4, features, landmarks, correspondence=[0, 0, 1, 1]
        ),
        "Estimate": pf.estimate(),
        "ScanMatch": match,
        "2 scan matches": gs.match_scan(run.scans[:2], run.scans[1:], SCANNER, backend="numpy"),
        "Location": gs.locate_scan(field, run.scans[0], resolution=0.2, angle=0.1),
        "MapMatch": gs.match_map(grid, grid, (0, 0, 0), (0.2, 0.2, 0.1), backend="numpy"),
        "DiscreteFit": gs.DiscreteBeamModel.learn(run.scans, expected, range_max=8.0, bins=40).fit,
        "MotionFit": gs.fit_odometry_motion(drive.odometry, drive.poses),
        "PositionFix": gs.trilaterate([(0.0, 0.0), (4.0, 0.0)], [2.5, 2.5], sigma=0.1),
    }  # fmt: skip


NAMES = (
    "OccupancyGrid", "BeamModel", "LikelihoodFieldModel", "LandmarkModel", "HeadingModel", "BeamFit", "IncidenceFit",
    "PointFit", "LandmarkFit", "Estimate", "ScanMatch", "2 scan matches", "Location", "MapMatch",
    "PositionFix", "DiscreteFit", "MotionFit",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_shows_a_small_table(things, name):
    text = things[name]._repr_html_()
    page = Checked(text)
    assert page.cells[0].startswith(name) and "table" in page.tags
    assert len(text) < 20_000 and not page.tags & {"script", "style", "link"}


def test_every_kind_is_shown(things):
    assert set(things) == set(NAMES)


def test_values_are_those_of_the_object(things):
    cells = Checked(things["BeamFit"]._repr_html_()).cells
    fit = things["BeamFit"]
    assert f"{fit.parameters.sigma_hit:.5g}" in cells and f"{fit.standard_errors['sigma_hit']:.3g}" in cells
    cells = Checked(things["ScanMatch"]._repr_html_()).cells
    assert f"{things['ScanMatch'].pose[0]:.5g}" in cells
    cells = Checked(things["LikelihoodFieldModel"]._repr_html_()).cells
    assert "20 of 81" in cells and things["LikelihoodFieldModel"].explain() in cells


def test_text_is_escaped_and_cut():
    text = card("<b>&", [("<script>", '"x"', 1.23456789)], head=("<i>",), detail="a<b" + "x" * 5000)
    page = Checked(text)
    assert "script" not in page.tags and "<script>" in page.cells and "1.2346" in page.cells
    assert len(text) < LONGEST + 500


@pytest.mark.parametrize("shape", [(3, 5), (700, 300), (1, 1000)])
def test_a_map_is_a_small_picture_with_its_walls(shape):
    cells = np.zeros(shape, np.int8)
    cells[0, :] = 100
    cells[-1, -1] = -1 if shape[0] > 1 else 100
    grid = gs.OccupancyGrid(cells)
    picture = Image.open(io.BytesIO(thumbnail(grid.unknown, grid.occupied)))
    pixels = np.asarray(picture)
    assert picture.mode == "L" and max(pixels.shape) <= WIDEST
    assert (pixels[-1] == 60).all()  # Row 0 of the map is the lowest.
    assert shape[0] == 1 or pixels[0, -1] == 205


def test_a_picture_has_its_pixels():
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(grey_png(grey)))), grey)
