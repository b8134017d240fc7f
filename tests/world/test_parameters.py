"""The parameter classes: validation, replacement, dictionaries."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import json

import numpy as np
import pytest

from gpusense.world.parameters import BeamParameters, IncidenceParameters, LikelihoodFieldParameters


@pytest.mark.parametrize("parameters", [BeamParameters(), LikelihoodFieldParameters(interpolation="bilinear")])
def test_dictionaries_round_trip_through_json(parameters):
    values = json.loads(json.dumps(parameters.to_dict()))
    assert type(parameters).from_dict(values) == parameters


def test_entries_that_a_dictionary_lacks_are_the_defaults():
    assert BeamParameters.from_dict({"sigma_hit": 0.3}) == BeamParameters(sigma_hit=0.3)


def test_replace_validates_the_result():
    parameters = BeamParameters()
    assert parameters.replace(sigma_hit=0.3) == BeamParameters(sigma_hit=0.3)
    assert parameters.sigma_hit == 0.05
    with pytest.raises(ValueError, match="z_hit"):
        parameters.replace(z_hit=0.6)


def test_the_weights_may_be_off_by_a_millionth():
    BeamParameters(0.7 + 0.9e-6, 0.1, 0.1, 0.1)
    with pytest.raises(ValueError, match="z_hit"):
        BeamParameters(0.7 + 1.1e-6, 0.1, 0.1, 0.1)


TWO = IncidenceParameters((0, 0.6, np.pi / 2), (BeamParameters(), BeamParameters(sigma_hit=0.3)))


def test_parameters_for_each_angle_of_incidence():
    assert TWO.edges == (0.0, 0.6, np.pi / 2)
    assert IncidenceParameters.from_dict(json.loads(json.dumps(TWO.to_dict()))) == TWO
    assert len({TWO, IncidenceParameters(TWO.edges, TWO.parameters)}) == 1
    three = IncidenceParameters(TWO.edges, TWO.parameters, BeamParameters(sigma_hit=0.4))
    assert IncidenceParameters.from_dict(json.loads(json.dumps(three.to_dict()))) == three != TWO
    assert IncidenceParameters.from_dict({"edges": TWO.edges, "parameters": TWO.to_dict()["parameters"]}) == TWO


@pytest.mark.parametrize(
    ("edges", "parameters", "error", "message"),
    [
        ((0, 1), TWO.parameters[:1], ValueError, "edges: must rise from 0 to pi / 2, got (0, 1)"),
        ((0, 1, 0.5, np.pi / 2), TWO.parameters, ValueError, "edges: must rise from 0 to pi / 2, got"),
        ((0.1, np.pi / 2), TWO.parameters[:1], ValueError, "edges: must rise from 0 to pi / 2, got"),
        ((0, np.nan, np.pi / 2), TWO.parameters, ValueError, "edges: every value must be finite"),
        (TWO.edges, TWO.parameters[:1], ValueError, "parameters: must be one for each of 2 bins, got 1"),
        (TWO.edges, (BeamParameters(), 3), TypeError, "parameters: must be BeamParameters, got 3"),
        (TWO.edges, TWO.parameters, TypeError, "no_surface: must be BeamParameters or None, got 3"),
    ],
)
def test_bad_parameters_for_angles_of_incidence(edges, parameters, error, message):
    with pytest.raises(error) as raised:
        IncidenceParameters(edges, parameters, 3 if "no_surface" in message else None)
    assert str(raised.value).startswith(message)


@pytest.mark.parametrize("kind", [BeamParameters, IncidenceParameters, LikelihoodFieldParameters])
def test_every_parameter_is_documented(kind):
    body = ast.parse(inspect.getsource(kind)).body[0].body
    documented = {
        node.target.id
        for node, after in itertools.pairwise(body)
        if isinstance(node, ast.AnnAssign) and isinstance(after, ast.Expr)
    }
    assert documented == {field.name for field in dataclasses.fields(kind)}
