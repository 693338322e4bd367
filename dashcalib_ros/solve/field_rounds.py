"""The field is found in Gauss-Newton rounds with the camera, and taken out of the tracks."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.camera.field import TERMS, Field
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.field import FieldProblem, FoundField, field_basis, without_field
from dashcalib_ros.solve.fitting import retriangulate_all, with_points_settled
from dashcalib_ros.solve.knowledge import is_clear
from dashcalib_ros.solve.normal import Normal, noise_in, normal_equations
from dashcalib_ros.solve.prior import loss_px_of, wider_prior
from dashcalib_ros.solve.steps import Fit, is_rolling

# px: of the loss in the rounds with a part of the tracks; a windscreen's 2 px would be cut off by
# the usual one. With all tracks it is the usual one
LOSSES = (2.0, 1.0, 0.5)
LAST_LOSSES = (0.0, 0.0)
# of evidence; from here on a field counts in sigma. Sound lenses have -0.1 to 0.9
DOUBT_NATS = 1.0
# noise variances of a track by which turns that did not make a field must be predicted better:
# half of what a lens model needs, as the evidence spoke for the field before (KITTI 07: 29)
LEAST_GAIN = 15.0


def with_field(first: Fit) -> Fit:
    """Return the fit with the field taken out of its tracks, where the turns confirm one.

    Where only the evidence speaks for a field, the fit keeps its prior, for its sigma. A field
    looks like a rolling shutter, too: where one was found, the field is sought without, and is
    there only if no rolling shutter is left beside it.
    """
    if len(first.scenes) < 2:
        return first
    if not first.readout_s:
        return _with_field(first)
    global_shutter = first.with_few_tracks().as_measured().retriangulated()
    found = _with_field(replace(global_shutter.adjusted().retriangulated(),
                                measured=first.measured))
    return first if found.used_field is None or is_rolling(*found.readout_left) else found


def _with_field(first: Fit) -> Fit:
    settings, size = first.config.intrinsics, first.camera.image_size
    none = FoundField(Field(size, np.zeros((2, len(TERMS)))), field_basis(first.camera), np.inf)
    usual = loss_px_of(first.scenes, first.camera, settings)
    evidence = _problem(first, none, usual)[1].evidence(size[0])
    if evidence.nats < DOUBT_NATS:
        return first
    doubtful = replace(first, field=replace(none, sigma_px=evidence.sigma_px))
    if evidence.nats < settings.least_field_nats:
        return doubtful
    found = _rounds(replace(first, field=none), LOSSES)
    if found is None:
        return doubtful
    found = found.with_usual_loss().adjusted().retriangulated()
    _, problem = _problem(found, _field_of(found), found.solver.loss_px)
    gains = problem.gains_of_turns_left_out(problem.evidence(size[0]))
    return found if is_clear(gains, LEAST_GAIN) else doubtful


def with_field_of_all_tracks(fit: Fit) -> Fit:
    """Return the fit with its field, found with a part of the tracks, estimated anew."""
    if fit.used_field is None:
        return fit
    return _rounds(fit, LAST_LOSSES) or fit


def _rounds(first: Fit, losses: Sequence[float]) -> Fit | None:
    """Return the fit after a Gauss-Newton round for each loss, px, at the least.

    None where it loses a turn.
    """
    now, config = first, first.config
    for least_px in losses:
        found, camera = _field_of(now), now.camera
        limits = replace(config.scene, error_px=max(config.scene.error_px, 2 * least_px))
        now = _settled(now, least_px)
        normals, problem = _problem(now, found, _loss_px(now, least_px))
        evidence = problem.evidence(camera.image_size[0])
        step = problem.step(evidence, len(camera.names()))
        field = Field(camera.image_size, found.field.coefficients
                      + (found.basis @ step[len(problem.lens.score):]).reshape(2, -1))
        camera = camera.with_params(camera.params + step[:len(camera.names())])
        if not camera.covers_picture():
            return None
        scenes = [replace(_with_other(scene, found.field, field),
                          structure=normal.eliminated.moved(scene.structure, step))
                  for scene, normal in zip(now.scenes, normals, strict=True)]
        scenes = retriangulate_all(scenes, camera, limits)
        if len(scenes) < len(first.scenes):
            return None
        now = replace(now, scenes=scenes, camera=camera, field=FoundField(
            field, found.basis, evidence.sigma_px, evidence.inflation))
    return _settled(now, least_px)


def _loss_px(fit: Fit, least_px: float) -> float:
    return max(loss_px_of(fit.scenes, fit.camera, fit.config.intrinsics), least_px)


def _settled(fit: Fit, least_px: float) -> Fit:
    """Return the fit with each point where its observations ask for it; poses are fixed."""
    loss_px = _loss_px(fit, least_px)
    return replace(fit, scenes=[with_points_settled(scene, fit.camera, loss_px)
                                for scene in fit.scenes])


def _field_of(fit: Fit) -> FoundField:
    assert fit.field is not None
    return fit.field


def _with_other(scene: Scene, before: Field, after: Field) -> Scene:
    """Return a scene whose tracks are without one field, without another one."""
    measured = replace(scene, tracks=replace(scene.tracks, xy=before.observed(scene.tracks.xy)))
    return without_field(measured, after)


def _problem(now: Fit, found: FoundField, loss_px: float) -> tuple[list[Normal], FieldProblem]:
    """Return the linearised problem of the lens and the field; loss_px: of the Cauchy loss."""
    noise = noise_in(now.scenes, now.camera, loss_px)
    normals = [normal_equations(scene, now.camera, loss_px, [found.further(now.camera)])
               for scene in now.scenes]
    return normals, FieldProblem(tuple(normal.cost.at_noise(noise) for normal in normals),
                                 wider_prior(now.camera, now.centred, now.config.intrinsics),
                                 found.directions)
