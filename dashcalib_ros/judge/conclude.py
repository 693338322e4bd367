"""Solution and evidence -> the Calibration that is given to the user."""
from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from dataclasses import field as default
from importlib import metadata
from types import MappingProxyType

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import AUTO
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend, Lines, bend
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.detect.straights import Straights
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.input.motion import SensorStream, speeds_of
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge.agreement import focal_disagreement
from dashcalib_ros.judge.calibration import (
    Calibration,
    LensField,
    Material,
    Mount,
    Shutter,
    Stabiliser,
    StoredTurnSummary,
    TurnSummary,
    Verdict,
)
from dashcalib_ros.judge.mount import Speed, mount_of
from dashcalib_ros.judge.verdict import (
    STEADY,
    Finding,
    judge,
    profile_contrast,
    verdict_of,
)
from dashcalib_ros.judge.witnesses import Asked
from dashcalib_ros.reconstruct.scene import Scene, TurnPicture, picture_of, rms_px
from dashcalib_ros.reconstruct.scene_file import StoredTurn
from dashcalib_ros.solve.fixed_camera import largest_crop
from dashcalib_ros.solve.knowledge import PictureSigma
from dashcalib_ros.solve.solution import LeftOut, Solution, cross_validation

# why turns are not used
CONTRADICTS = 'the camera of the other turns does not explain it'
NOT_NEEDED = 'more prominent turns were enough'

# result.json has their versions: a result's last digits depend on them
PACKAGES = (
    'dashcalib_ros', 'numpy', 'scipy', 'opencv-python-headless', 'av', 'pycolmap', 'pyceres')
# of fx or the width; a warning comes if p1, p2 and k3 would change more
MAX_UNTOLD_MODEL_ERROR = 0.005
# px RMS; a warning tells of a field that no lens model has, if it is larger
TOLD_FIELD_PX = 0.5


@dataclass(frozen=True)
class Evidence:
    """What a calibration needs beside the solution.

    image_size: of the input; scale: how it was resized for the scenes. built: scenes by their
    turn. stored: the turns of earlier drives that were available. left_out: why turns were taken
    out, in words. pictures: of turns whose images are gone; None: the report is not wanted.
    start_s: stamp of the first image. lines: upright ones, in the resized images; None where they
    were not looked for. straights: pairs of images of straight driving, likewise. motion: of the
    car's sensors; asked: what they say.
    """

    image_size: tuple[int, int]
    frames: int
    turns: tuple[Turn, ...]
    built: dict[TurnId, Scene]
    magnitudes: Floats
    mask: Mask | None
    scale: Scale
    timing: dict[str, float]
    warnings: tuple[str, ...] = ()
    stored: tuple[StoredTurn, ...] = ()
    left_out: Mapping[TurnId, str] = default(default_factory=dict)
    pictures: Mapping[TurnId, TurnPicture] | None = default(default_factory=dict)
    start_s: float = 0.0
    lines: Lines | None = None
    straights: Straights | None = None
    motion: SensorStream | None = None
    asked: Asked = default(default_factory=Asked)


def evidence_of_detection(detection: Detection, scenes: Iterable[Scene | None] = (),
                          timing: Mapping[str, float] | None = None,
                          warnings: tuple[str, ...] = (),
                          stored: tuple[StoredTurn, ...] = (),
                          left_out: Mapping[TurnId, str] | None = None,
                          pictures: Mapping[TurnId, TurnPicture] | None = MappingProxyType({})
                          ) -> Evidence:
    """Return the evidence from the first stage and from the scenes of its turns.

    scenes: in any order; a turn without one is listed as not reconstructed. left_out, pictures:
    as Evidence's.
    """
    return Evidence(
        image_size=detection.size or (0, 0), scale=detection.scale, frames=detection.frames,
        turns=detection.turns(), magnitudes=detection.magnitudes(), mask=detection.valid(),
        built={scene.turn: scene for scene in scenes if scene is not None},
        timing=dict(timing or {}), warnings=(*detection.warnings(), *warnings), stored=stored,
        left_out=left_out or {}, pictures=pictures, start_s=detection.start_s,
        lines=detection.lines(), straights=detection.straights())


def conclude(solution: Solution | None, evidence: Evidence, config: Config) -> Calibration:
    """Return the calibration; a refused one has no intrinsics, so that they cannot be used."""
    if solution is not None:
        solution = replace(solution, px=evidence.scale.px)
    witness = _witness(solution, evidence, config)
    asked = evidence.asked
    verdict = (judge(solution, config.verdict, witness, True, asked.witnesses) if solution
               else _verdict_without_solution(evidence))
    camera = sigma = error = shutter = sigma_px = stabiliser = straight_lines = None
    field = mount = None
    details: dict[str, object] = {}
    without: tuple[LeftOut, ...] = ()
    warnings = evidence.warnings + asked.unused
    if solution is not None and verdict.level != 'accepted' and config.model != AUTO:
        warnings += (f'the lens model {config.model} was asked for and may be why the result is '
                     f'{verdict.level}: --model {AUTO} takes the one that the turns prove',)
    if solution is not None:
        details = _details(solution)
        if solution.alone is not None:
            details['pictures_alone'] = _alone(solution.alone, evidence.scale.px)
        if verdict.level != 'refused':
            px = evidence.scale.px
            camera = solution.camera.resized(px, evidence.image_size)
            # fx, fy, cx and cy are pixels
            units = np.where(np.arange(len(solution.sigma)) < 4, px, 1)
            sigma = dict(zip(camera.names(), (solution.sigma * units).tolist(), strict=True))
            wider = solution.wider_covariance
            units = np.where(np.arange(len(wider)) < 4, px, 1)
            details['picture_covariance'] = (wider * np.outer(units, units)).tolist()
            error = solution.reprojection_error_px * px
            sigma_px = PictureSigma(solution.picture.rms * px, solution.picture.worst * px)
            without = tuple(each.times(px) for each in cross_validation(solution))
            straight_lines = witness and witness.resized(px)
            warnings += _model_error_warnings(solution, px, config)
            field = _field(solution, px, evidence.image_size)
            if field is not None and field.used and field.rms_px >= TOLD_FIELD_PX:
                warnings += (f'the picture is bent by {field.rms_px:.1f} px (up to '
                             f'{field.worst_px:.1f} px), as by a windscreen or a rectification: '
                             f'camera_info cannot say that, and sigma over the picture allows '
                             f'for it; `dashcalib export --to rays` has it',)
            mount = _mount(solution, evidence, verdict.level, config)
            if mount is not None and mount.moved_s is not None:
                warnings += (f'the camera was moved on the car '
                             f'{mount.moved_s - evidence.start_s:.0f} s into the drive: how it '
                             f'sits is told from there on',)
            if solution.readout_s:
                shutter = Shutter(1e3 * solution.readout_s, 1e3 * solution.readout_sigma_s)
        if solution.crops:
            stabiliser = Stabiliser(largest_crop(solution.crops) * evidence.scale.px)
            if STEADY not in verdict.cures:
                warnings += (f'the picture seems to move by up to {stabiliser.largest_px:.0f} px '
                             f'against the lens, no more than the lens is uncertain; that was '
                             f'taken out: {STEADY}',)
    return Calibration(
        verdict=verdict, image_size=evidence.image_size, camera=camera, sigma=sigma,
        turns=tuple(_summary(turn, evidence, solution)
                    for turn in sorted(evidence.turns, key=lambda turn: turn.center)),
        frames=evidence.frames, reprojection_error_px=error, timing=evidence.timing,
        versions=_versions(), config=config, magnitudes=evidence.magnitudes,
        mask=_of_size(evidence.mask, evidence.image_size), held_out=without,
        details=details, rolling_shutter=shutter, stabiliser=stabiliser, sigma_px=sigma_px,
        field=field, mount=mount, warnings=warnings, start_s=evidence.start_s,
        straight_lines=straight_lines, witnesses=asked.witnesses,
        material=_material(solution, evidence),
        stored_turns=tuple(_stored_summary(turn, evidence, solution) for turn in evidence.stored))


def _witness(solution: Solution | None, evidence: Evidence, config: Config) -> Bend | None:
    """Return what straight lines say of the solution, in the resized images."""
    if solution is None or evidence.lines is None:
        return None
    return bend(evidence.lines, solution.camera, config.lines, solution.covariance)


def _mount(solution: Solution, evidence: Evidence, level: str, config: Config) -> Mount | None:
    """Return how the camera sits on the car; a failure there must not cost the lens."""
    if evidence.straights is None or not config.mount.enabled:
        return None
    with suppress(np.linalg.LinAlgError, ValueError):
        return mount_of(evidence.straights, evidence.lines, solution, level, evidence.scale.px,
                        _speed(evidence, config))
    return None


def _speed(evidence: Evidence, config: Config) -> Speed | None:
    """Return the car's speed, m/s, at stamps of pictures; None where it is not known."""
    constant = config.mount.speed_kmh / 3.6
    if constant:
        return lambda stamps_s: np.full(len(stamps_s), constant)
    if evidence.motion is None:
        return None
    known = speeds_of(evidence.motion.since(evidence.start_s))
    if known is None:
        return None
    return lambda stamps_s: np.interp(stamps_s - evidence.start_s, known.stamps_s,
                                      known.values[:, 0], left=0.0, right=0.0)


def _of_size(mask: Mask | None, size: tuple[int, int]) -> Mask | None:
    """Return the mask of resized images for images of this (width, height)."""
    if mask is None:
        return None
    row, column = (np.arange(length) * count // length
                   for length, count in zip(size[::-1], mask.shape, strict=True))
    return np.asarray(mask[np.ix_(row, column)], bool)


def _field(solution: Solution, px: float, image_size: tuple[int, int]) -> LensField | None:
    """Return the field for the full-size images; px: of the input, in one pixel of the scenes."""
    if solution.field is None:
        return None
    sizes = px * solution.field.field.over(solution.camera)
    return LensField(
        solution.field.field.resized(px, image_size), solution.field.used,
        float(np.sqrt(np.mean(sizes**2))), float(sizes.max()), px * solution.rays_sigma_px)


def _model_error_warnings(solution: Solution, px: float, config: Config) -> tuple[str, ...]:
    """Return a warning if a wider model would clearly change fx, fy, cx or cy.

    px: of the input, in one pixel of the scenes.
    """
    count, names = len(solution.known.own), solution.camera.widened().names()
    step = solution.known.step_to_wider_model
    shifts, others = step[:4], step[count:]
    scale = np.repeat([solution.camera.fx, solution.camera.image_size[0]], 2)
    if not np.max(np.abs(shifts) / scale) > MAX_UNTOLD_MODEL_ERROR:
        return ()
    changes = ', '.join(f'{name} by {px * shift:+.1f}'
                        for name, shift in zip(names, shifts, strict=False))
    found = [f'{name} {value:+.4f}' for name, value in zip(names[count:], others, strict=True)]
    return (f'the lens seems to have more distortion than the model {solution.camera.model} tells '
            f'({", ".join(found)}), which would change {changes} px: the sigmas allow for that',)


def _verdict_without_solution(evidence: Evidence) -> Verdict:
    """Return the verdict on a drive that gave no scene."""
    if evidence.frames < 2:
        what, cure = f'there is only {evidence.frames} image', 'record a drive with turns'
    elif not evidence.turns:
        what = ('no turn was found: the car stood or drove straight on, or the pictures show too '
                'little')
        cure = 'record a drive with turns at crossings, in daylight'
    else:
        what = (f'none of the {len(evidence.turns)} turns could be reconstructed: the pictures '
                f'are too dark or blurred, or the camera turned without moving')
        cure = 'drive through turns at town speed, in daylight'
    return verdict_of([Finding('refused', what, cure)])


def _summary(turn: Turn, evidence: Evidence, solution: Solution | None) -> TurnSummary:
    used = {scene.turn: scene for scene in solution.scenes} if solution else {}
    scene = used.get(turn.id) or evidence.built.get(turn.id)
    error = None if scene is None else _error_px(scene, evidence, solution)
    return TurnSummary(
        center=turn.center, first=turn.first, last=turn.last, stamp_s=turn.stamp_s,
        prominence=turn.prominence, images=len(scene.tracks.frames) if scene else turn.images,
        registered=int(scene.structure.registered.sum()) if scene else 0,
        used=turn.id in used, yaw_deg=scene.yaw_deg if scene else None,
        reprojection_error_px=error,
        misfit=solution.misfits.get(turn.id) if solution else None,
        unused_because=None if turn.id in used else _unused_because(turn, evidence, solution))


def _unused_because(turn: Turn, evidence: Evidence, solution: Solution | None) -> str:
    """Return why a turn of this drive is not used, in words."""
    if turn.id in evidence.left_out:
        return evidence.left_out[turn.id]
    if turn.id in evidence.built:
        return _scene_unused_because(turn.id, solution)
    return NOT_NEEDED if solution else 'it was not reconstructed'


def _scene_unused_because(turn: TurnId, solution: Solution | None) -> str:
    if solution is None:
        return 'no camera explains what was seen in it'
    misfit = solution.misfits.get(turn)
    if misfit is None:
        return NOT_NEEDED
    return f'{CONTRADICTS}, with {misfit:.1f} times the error of a camera of its own'


def _material(solution: Solution | None, evidence: Evidence) -> Material | None:
    """Return what the report draws; None where none is wanted."""
    if evidence.pictures is None:
        return None
    scenes = {turn.scene.turn: turn.scene for turn in evidence.stored} | evidence.built
    if solution is not None:
        scenes |= {scene.turn: scene for scene in solution.scenes}
    pictures = dict(evidence.pictures)
    for turn in evidence.turns:
        picture = None if turn.id in pictures else picture_of(turn, scenes.get(turn.id))
        if picture is not None:
            pictures[turn.id] = picture
    return Material(evidence.scale.px, solution, scenes, pictures)


def _stored_summary(turn: StoredTurn, evidence: Evidence, solution: Solution | None
                    ) -> StoredTurnSummary:
    used = {each.turn: each for each in solution.scenes} if solution else {}
    scene = used.get(turn.scene.turn, turn.scene)
    return StoredTurnSummary(scene.turn, turn.stamp_s, turn.prominence, turn.scene.yaw_deg,
                             len(scene.tracks.frames), scene.turn in used,
                             solution.misfits.get(scene.turn) if solution else None,
                             None if scene.turn in used else evidence.left_out.get(
                                 scene.turn, _scene_unused_because(scene.turn, solution)),
                             _error_px(scene, evidence, solution))


def _error_px(scene: Scene, evidence: Evidence, solution: Solution | None) -> float:
    """Return a turn's reprojection error in px of the input; unused, by its own camera."""
    used = solution is not None and any(scene is each for each in solution.scenes)
    camera = solution.camera if solution and used else scene.camera
    return rms_px([scene], camera) * evidence.scale.px


def _details(solution: Solution) -> dict[str, object]:
    width = solution.camera.image_size[0]
    others = len(solution.known.own)
    return {
        'step1': {'f_over_width': solution.centred.fx / width,
                  **dict(list(solution.centred.named.items())[4:])},
        'focal_profile': {'f_over_width': solution.around.ratios.tolist(),
                          'cost_px2': solution.around.costs.tolist()},
        'profile_contrast': profile_contrast(solution),
        'turns_disagree_fx': focal_disagreement(solution),
        'left_out': dict(zip(solution.camera.widened().names()[others:],
                             solution.known.step_to_wider_model[others:].tolist(), strict=True)),
        'fixed_camera': {each.kind: {'strength': each.strength, 'size': each.size}
                         for each in solution.fixed_camera},
        'models': [asdict(candidate) for candidate in solution.tried],
        'correlation': (solution.covariance / np.outer(solution.sigma, solution.sigma)).tolist(),
    }


def _alone(solution: Solution, px: float) -> dict[str, float]:
    """Return what pictures alone say of fx, where a gyro is in the solution, px of the input."""
    return {'fx': px * solution.camera.fx, 'sigma_fx': px * float(solution.sigma[0])}


def _versions() -> dict[str, str]:
    versions = {'python': platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = 'unknown'
    return versions
