"""Points of a cloud beside its reference: the note says how they are left out, in every CRS."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from compare_plane import ORIGIN, UTM32
from pyproj import CRS

from geo import Cloud, LocalFrame, Mesh
from survey.compare.comparison import _edge_note
from survey.compare.inputs import InputPaths, Inputs


@pytest.mark.parametrize("crs", [UTM32, CRS("EPSG:4326+5773")])
def test_points_beside_a_mesh_are_left_out_by_bounds_that_hold_it_and_those_in_its_holes_are_not(crs):
    unit = 1.0 if crs is UTM32 else 1e-5
    at = np.array([*ORIGIN[:2], 0.0]) if crs is UTM32 else np.array([11.36123456, 46.9, 0.0])
    corners = at + np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [5 * unit, 5 * unit, 1.0]
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1], [0, 3, 2]]), crs=crs)
    points = at + np.column_stack([np.linspace(-9, 9, 50), np.zeros(50), np.zeros(50)]) * [unit, unit, 1.0]
    frame = LocalFrame(crs, tuple(at.tolist()))
    paths = InputPaths(Path("c.las"), Path("r.ply"))
    inputs = Inputs(paths, Cloud(points=points, crs=crs), np.ones(50, bool), 0, mesh, None, crs, frame, ())
    is_off = np.abs(points[:, 0] - at[0]) > 5 * unit
    (note,) = _edge_note(inputs, np.where(is_off, np.nan, 0.0))
    bounds = tuple(float(word) for word in re.findall(r"--bounds (.*?),", note)[0].split())
    (west, _), (east, _) = corners[0, :2], corners[1, :2]
    assert (bounds[0], bounds[2]) == pytest.approx((west, east), abs=0.001 * unit, rel=0.0)
    (note,) = _edge_note(inputs, np.where(is_off, 0.0, np.nan))
    assert "they are in holes of r.ply" in note
