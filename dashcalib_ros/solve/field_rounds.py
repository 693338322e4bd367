"""The field is found in Gauss-Newton rounds with the camera, and taken out of the tracks."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.camera.field import TERMS, Field
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruct.adjust import Solver, adjust_step2
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.choice import is_clear
from dashcalib_ros.solve.field import FieldProblem, FoundField, field_basis, without_field
from dashcalib_ros.solve.fitting import retriangulate_all
from dashcalib_ros.solve.information import noise_in
from dashcalib_ros.solve.normal import Normal, normal_equations
from dashcalib_ros.solve.prior import (
    bounds_of,
    extra_sigma_of,
    loss_px_of,
    prior_information,
    prior_of,
)
from dashcalib_ros.solve.steps import Result

# px: of the loss in the first rounds; a windscreen's 2 px would be cut off by the usual one. In
# the last rounds it is the usual one
LOSSES = (2.0, 1.0, 0.5, 0.0, 0.0)
# with all tracks
LAST_LOSSES = (0.0, 0.0)


def with_field(first: Result, config: Config) -> Result:
    """Return the result with the field taken out of its tracks, where the turns confirm one.

    Where only the evidence speaks for a field, the result keeps its prior, for its sigma. What the
    removal of a rolling shutter leaves looks like a field: behind one, none is looked for.
    """
    settings, fit = config.intrinsics, first.fit
    if len(fit.scenes) < 2 or fit.readout_s:
        return first
    none = FoundField(Field(fit.camera.image_size, np.zeros((2, len(TERMS)))),
                      field_basis(fit.camera), np.inf)
    usual = loss_px_of(fit.scenes, fit.camera, settings)
    evidence = _problem(first, none, usual)[1].evidence(fit.camera.image_size[0])
    if evidence.nats < settings.least_field_nats:
        return first
    doubtful = _with(first, replace(none, sigma_px=evidence.sigma_px))
    found = _rounds(_with(first, none), LOSSES, config)
    if found is None:
        return doubtful
    found = _adjusted(found, config)
    _, problem = _problem(found, _field_of(found), found.fit.solver.loss_px)
    gains = problem.held_out_gains(problem.evidence(fit.camera.image_size[0]))
    return found if is_clear(gains, settings.least_gain) else doubtful


def with_field_of_all_tracks(result: Result, config: Config) -> Result:
    """Return the result with its field, found with a part of the tracks, estimated anew."""
    if result.used_field is None:
        return result
    return _rounds(result, LAST_LOSSES, config) or result


def _rounds(first: Result, losses: Sequence[float], config: Config) -> Result | None:
    """Return the result after a Gauss-Newton round for each loss, px, at the least.

    None where it loses a turn.
    """
    settings, now = config.intrinsics, first
    for least_px in losses:
        found, camera = _field_of(now), now.fit.camera
        loss_px = max(loss_px_of(now.fit.scenes, camera, settings), least_px)
        limits = replace(config.scene, error_px=max(config.scene.error_px, 2 * least_px))
        normals, problem = _problem(now, found, loss_px)
        evidence = problem.evidence(camera.image_size[0])
        step = problem.step(evidence, len(camera.names()))
        field = Field(camera.image_size, found.field.coefficients
                      + (found.basis @ step[normals[0].lens:]).reshape(2, -1))
        camera = camera.with_params(camera.params + step[:len(camera.names())])
        scenes = [replace(_with_other(scene, found.field, field),
                          structure=normal.eliminated.moved(scene.structure, step))
                  for scene, normal in zip(now.fit.scenes, normals, strict=True)]
        scenes = retriangulate_all(scenes, camera, limits)
        if len(scenes) < len(first.fit.scenes) or not camera.covers_picture():
            return None
        now = _with(replace(now, fit=replace(now.fit, scenes=scenes, camera=camera)),
                    FoundField(field, found.basis, evidence.sigma_px, evidence.inflation))
    return now


def _field_of(result: Result) -> FoundField:
    assert result.fit.field is not None
    return result.fit.field


def _with(result: Result, found: FoundField) -> Result:
    return replace(result, fit=replace(result.fit, field=found))


def _with_other(scene: Scene, before: Field, after: Field) -> Scene:
    """Return a scene whose tracks are without one field, without another one."""
    measured = replace(scene, tracks=replace(scene.tracks, xy=before.observed(scene.tracks.xy)))
    return without_field(measured, after)


def _adjusted(found: Result, config: Config) -> Result:
    """Return the result adjusted once more, with its field held."""
    fit, settings = found.fit, config.intrinsics
    loss_px = loss_px_of(fit.scenes, fit.camera, settings)
    scenes, camera = adjust_step2(
        fit.scenes, fit.camera, Solver(loss_px, config.scene.iterations),
        prior_of(found.step1, settings, fit.noise(loss_px)), bounds_of(found.step1, settings))
    scenes = retriangulate_all(scenes, camera, config.scene)
    return replace(found, fit=replace(fit, scenes=scenes, camera=camera, solver=replace(
        fit.solver, loss_px=loss_px)))


def _problem(now: Result, found: FoundField, loss_px: float
             ) -> tuple[list[Normal], FieldProblem]:
    """Return the linearised problem of the lens and the field; loss_px: of the Cauchy loss."""
    camera, scenes = now.fit.camera, now.fit.scenes
    noise = noise_in(scenes, camera, loss_px)
    normals = [normal_equations(scene, camera, loss_px, found.columns(scene, camera))
               for scene in scenes]
    count, lens = len(camera.names()), len(camera.widened().names())
    information = prior_information(now.step1, now.settings)
    prior, pull = np.zeros((lens, lens)), np.zeros(lens)
    prior[:count, :count] = information
    prior[count:, count:] = np.diag(1 / np.square(extra_sigma_of(camera)))
    pull[:count] = information @ (prior_of(now.step1, now.settings, 1.0).mean - camera.params)
    return normals, FieldProblem(
        np.array([normal.hessian for normal in normals]) / noise,
        np.array([normal.score for normal in normals]) / noise,
        np.array([normal.by_track for normal in normals]) / noise**2, prior, pull,
        found.directions)
