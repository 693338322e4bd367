# SPDX-License-Identifier: Apache-2.0
"""What holds for every camera whose parameters are in their ranges."""
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dashcalib_ros.camera import MODELS, Camera, camera_from_ros, ros_camera

QUICK = settings(derandomize=True, deadline=None, max_examples=60, database=None)
# of the prior's standard deviation, by which a coefficient is off 0
SPREADS = 0.3


@st.composite
def cameras(draw: st.DrawFn, model: type[Camera]) -> Camera:
    width, height = draw(st.integers(320, 4096)), draw(st.integers(240, 2160))
    focal = width * draw(st.sampled_from(model.focal_ratios))
    values = [focal, focal * draw(st.floats(0.98, 1.02)), width * draw(st.floats(0.4, 0.6)),
              height * draw(st.floats(0.4, 0.6))]
    values += [spread * draw(st.floats(-SPREADS, SPREADS)) for spread in model.spread]
    return model.of((width, height), values)


@pytest.mark.parametrize('model', MODELS.values(), ids=list(MODELS))
@QUICK
@given(data=st.data())
def test_a_pixel_that_has_a_ray_is_where_the_ray_is_seen(model: type[Camera],
                                                         data: st.DataObject) -> None:
    camera = data.draw(cameras(model))
    x, y = np.meshgrid(*(np.linspace(0, side - 1, 9) for side in camera.image_size))
    pixels = np.stack([x, y], -1)
    rays = camera.rays(pixels)
    known = np.isfinite(rays).all(axis=-1)
    assert np.allclose(np.linalg.norm(rays[known], axis=-1), 1)
    again = camera.project(rays[known])
    # at the fold itself a ray may be just beyond it
    seen = np.isfinite(again).all(axis=-1)
    # rays() is exact to 1e-6 of the focal length
    assert np.abs(again - pixels[known])[seen].max(initial=0.0) < 3e-6 * max(camera.fx, camera.fy)
    assert seen.sum() >= 0.9 * known.sum()
    assert np.isfinite(camera.rays(camera.params[2:4])).all()


@pytest.mark.parametrize('model', MODELS.values(), ids=list(MODELS))
@QUICK
@given(data=st.data())
def test_a_camera_is_the_same_after_ros(model: type[Camera], data: st.DataObject) -> None:
    camera = data.draw(cameras(model))
    told = ros_camera(camera)
    again = camera_from_ros((told.width, told.height), told.distortion_model, told.k, told.d)
    # the simplest model that has all of them
    assert np.array_equal(*(np.trim_zeros(each.ros_distortion(), 'b') for each in (again, camera)))
    assert np.array_equal(again.params[:4], camera.params[:4])


@pytest.mark.parametrize('model', MODELS.values(), ids=list(MODELS))
@QUICK
@given(data=st.data(), factor=st.sampled_from([0.25, 0.5, 2.0, 3.0]))
def test_a_resized_camera_has_the_same_rays(model: type[Camera], data: st.DataObject,
                                            factor: float) -> None:
    camera = data.draw(cameras(model))
    other = camera.resized(factor, camera.image_size)
    pixels = np.array([[camera.cx, camera.cy], [camera.cx + 20, camera.cy - 9]])
    assert np.allclose(other.rays((pixels + 0.5) * factor - 0.5), camera.rays(pixels), atol=1e-9)
