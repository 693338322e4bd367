# SPDX-License-Identifier: Apache-2.0
"""Solution and evidence -> the CalibrationData that is given to the user."""
from __future__ import annotations

import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from dataclasses import field as default
from functools import partial
from importlib import metadata
from typing import Any

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import AUTO, Camera
from dashcalib_ros.config import Config, ReconstructConfig, VerdictConfig
from dashcalib_ros.detect import Bend, Lines, bend
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.detect.one_camera import OtherCamera
from dashcalib_ros.detect.straights import Straights
from dashcalib_ros.detect.turn import Turn, TurnId, is_turn
from dashcalib_ros.errors import Notice, counted, spared
from dashcalib_ros.input.motion import Samples, SensorStream, speed_sigma, speeds_of
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge.agreement import CONTRADICTS, STOOD, focal_disagreement
from dashcalib_ros.judge.calibration import (
    CalibrationData,
    CameraAt,
    Drift,
    Known,
    LensField,
    Material,
    Mount,
    Part,
    Shutter,
    Stabiliser,
    StoredTurnSummary,
    TurnSummary,
    Verdict,
)
from dashcalib_ros.judge.known import with_known
from dashcalib_ros.judge.mount import Speed, mount_of
from dashcalib_ros.judge.verdict import (
    STEADY,
    Finding,
    crop_matters,
    judge,
    profile_contrast,
    turn_count,
    two_cameras,
    verdict_of,
    yaw_in_all,
)
from dashcalib_ros.judge.witnesses import SensorComparison
from dashcalib_ros.problem.blocks import Warmth
from dashcalib_ros.problem.stamps import Times
from dashcalib_ros.reconstruct.scene import Scene, TurnPicture, picture_of, rms_px
from dashcalib_ros.solve.evidence import largest_crop
from dashcalib_ros.solve.solution import Solution, cross_validation
from dashcalib_ros.store.scene_file import StoredTurn

# why turns are not used
NOT_NEEDED = 'more prominent turns were enough'


@dataclass(frozen=True)
class Evidence:
    """What a calibration needs beside the solution.

    image_size: of the input; scale: how it was resized for the scenes. built: scenes by their
    turn. stored: the turns of earlier drives that were available. left_out: why turns were left
    out, in words. pictures: of turns whose images are gone; None: the report is not wanted.
    start_s: stamp of the first image. lines: upright ones, in the resized images; None where they
    were not looked for. straights: pairs of images of straight driving, likewise. motion: of the
    car's sensors; sensors: what they say. other_camera: that the stream has, too. temperature: on
    the images' clock.
    """

    image_size: tuple[int, int]
    frames: int
    turns: tuple[Turn, ...]
    built: dict[TurnId, Scene]
    magnitudes: Floats
    mask: Mask | None
    scale: Scale
    timing: dict[str, float]
    warnings: tuple[Notice, ...] = ()
    stored: tuple[StoredTurn, ...] = ()
    left_out: Mapping[TurnId, str] = default(default_factory=dict)
    pictures: Mapping[TurnId, TurnPicture] | None = default(default_factory=dict)
    start_s: float = 0.0
    lines: Lines | None = None
    straights: Straights | None = None
    motion: SensorStream | None = None
    sensors: SensorComparison = default(default_factory=SensorComparison)
    other_camera: OtherCamera | None = None
    temperature: Samples | None = None


def evidence_of_detection(detection: Detection, scenes: Iterable[Scene | None] = ()) -> Evidence:
    """Return the evidence from the first stage and from the scenes of its turns.

    scenes: in any order; a turn without one is listed as not reconstructed.
    """
    other, lost = detection.other_camera, list[Notice]()
    built = {scene.turn: scene for scene in scenes if scene is not None}
    stretches = (each for each in detection.stretches() if each.id in built)
    lines = spared('the search for straight lines', lost, detection.lines)
    straights = spared('the search for straight driving', lost, detection.straights)
    return Evidence(
        image_size=detection.size or (0, 0), scale=detection.scale, frames=detection.frames,
        turns=(*detection.turns(), *stretches), magnitudes=detection.magnitudes(),
        mask=detection.valid(),
        built=built, timing={},
        # the verdict says it
        warnings=(*(each for each in detection.warnings() if each.code != 'E-TWO-CAMERAS'),
                  *lost),
        other_camera=other, start_s=detection.start_s, lines=lines, straights=straights)


def conclude(solution: Solution | None, evidence: Evidence, config: Config) -> CalibrationData:
    """Return the calibration; a refused one has no intrinsics, so that they cannot be used.

    Where something fails that is neither the camera nor its verdict, that part is left out, with
    a warning.
    """
    lost: list[Notice] = []
    scenes = {turn.scene.turn: turn.scene for turn in evidence.stored} | evidence.built
    if solution is not None:
        solution = replace(solution, px=evidence.scale.px)
    lines = spared('the check of straight lines', lost, straight_lines, solution, evidence)
    witnesses, known = evidence.sensors.witnesses, tuple[Known, ...]()
    if solution is not None:
        informed = spared('what is known before', lost, with_known, solution, config,
                          evidence.scale.px, partial(_height, evidence=evidence, config=config))
        solution, known = informed or (solution, known)
        scenes |= {scene.turn: scene for scene in solution.scenes}
    found = CalibrationData(
        verdict=(judge(solution, config.verdict, lines, True, witnesses, evidence.other_camera)
                 if solution else _verdict_without_solution(evidence, config.verdict)),
        image_size=evidence.image_size, camera=None, sigma=None,
        turns=tuple(_summary(turn, scenes.get(turn.id), evidence, solution)
                    for turn in sorted(evidence.turns, key=lambda turn: turn.center)),
        frames=evidence.frames, reprojection_error_px=None, timing=evidence.timing,
        versions=versions(config.reconstruct), config=config,
        warnings=evidence.warnings + evidence.sensors.unused,
        magnitudes=evidence.magnitudes, mask=_of_size(evidence.mask, evidence.image_size),
        stored_turns=tuple(_stored_summary(turn, scenes[turn.scene.turn], evidence, solution)
                           for turn in evidence.stored),
        start_s=evidence.start_s, witnesses=witnesses, known=known,
        material=spared('what the report draws', lost, _material, scenes, solution, evidence))
    if solution is None:
        return replace(found, warnings=(*found.warnings, *lost))
    crop_px = largest_crop(solution.crops) * solution.px if solution.crops else None
    found = replace(found, details=spared('details', lost, _details, solution) or {},
                    stabiliser=None if crop_px is None else Stabiliser(largest_px=crop_px))
    if found.verdict.level != 'refused':
        found = _with_numbers(found, solution, lines, evidence, lost)
    if solution.parts:
        found = replace(found, parts=tuple(
            _part(part, solution, later, evidence, config)
            for later, part in enumerate(solution.parts)))
    return replace(found, warnings=(*found.warnings, *_warnings(found, solution, evidence), *lost))


@dataclass(frozen=True)
class Outlook:
    """The turns of a drive, and what a calibration of it can come to at best.

    turns: of this drive, the best first. yaws_deg: of the turns that a calibration would use, by
    their ids, those of earlier drives too. verdict: accepted where their number and their angles
    are enough; their pictures decide the rest. start_s: stamp of the first image.
    """

    frames: int
    turns: tuple[Turn, ...]
    yaws_deg: Mapping[TurnId, float]
    verdict: Verdict
    warnings: tuple[Notice, ...]
    start_s: float


def outlook(scenes: Sequence[Scene], evidence: Evidence, config: VerdictConfig) -> Outlook:
    """Return the best that a drive can come to. scenes: that a calibration would use."""
    return Outlook(evidence.frames, tuple(turn for turn in evidence.turns
                                          if is_turn(turn.prominence)),
                   {scene.turn: scene.yaw_deg for scene in scenes},
                   _best_verdict(scenes, evidence, config), evidence.warnings, evidence.start_s)


def _best_verdict(scenes: Sequence[Scene], evidence: Evidence, config: VerdictConfig) -> Verdict:
    """Return what the number of turns and their angles allow, as judge() counts."""
    if not scenes:
        return _verdict_without_solution(evidence, config)
    # a gyro may confirm a single turn
    gyro = evidence.motion is not None and evidence.motion.rate is not None
    found = [turn_count(scenes, config, gyro),
             yaw_in_all(sum(scene.yaw_deg for scene in scenes), config)]
    other = evidence.other_camera
    found = [two_cameras(other), *found] if other else found
    return verdict_of(sorted(found, key=lambda each: each.level != 'refused'))


def _in_input(camera: Camera, sigma: Floats, px: float, size: tuple[int, int]
              ) -> tuple[Camera, dict[str, float]]:
    """Return a camera of the input's pictures, and its sigmas by name. sigma: (n,), as solved."""
    full = camera.resized(px, size)
    return full, dict(zip(full.names(), (sigma * full.units(px)).tolist(), strict=True))


def _with_numbers(found: CalibrationData, solution: Solution, lines: Bend | None,
                  evidence: Evidence, lost: list[Notice]) -> CalibrationData:
    """Return the calibration with what a refused one has not, in the input's pixels."""
    held_out = spared('the comparison of each turn with the others', lost, cross_validation,
                      solution) or ()
    px = solution.px
    warmth = _warmth(solution, evidence)
    camera, sigma = _in_input(solution.camera, solution.sigma, px, evidence.image_size)
    units, wide = camera.units(px), camera.widened().units(px)
    return replace(
        found, camera=camera, sigma=sigma,
        covariance=solution.covariance * np.outer(units, units),
        picture_covariance=solution.wide_covariance * np.outer(wide, wide),
        reprojection_error_px=solution.reprojection_error_px * px,
        sigma_px=solution.picture.times(px),
        held_out=tuple(each.times(px) for each in held_out),
        straight_lines=lines and lines.resized(px), field=_field(solution, evidence.image_size),
        mount=spared('the mounting', lost, _mount, solution, evidence, found.verdict.level,
                     found.config),
        drift=_drift(solution), temperature_c=None if warmth is None else warmth.mean_c,
        intrinsics_at=_over_time(solution, evidence),
        rolling_shutter=Shutter(1e3 * solution.readout_s, 1e3 * solution.readout_sigma_s)
        if solution.rolling else None)


# of pixels that are not square, or are so where they seem not to be: a warning says it
REPORTED_SHARE = 0.05


def _drift(solution: Solution) -> Drift | None:
    found = solution.drift
    if found is None or not found.linear:
        return None
    per_hour = 100 * 3600 / found.seconds
    drift = Drift(per_hour * found.size, per_hour * found.sigma, 100 * found.size)
    warmth, of_kelvin = found.ways.warmth, found.of_kelvin
    if warmth is None or of_kelvin is None:
        return drift
    value, sigma = of_kelvin
    return replace(drift, fx_percent_per_kelvin=100 * value, sigma_per_kelvin=100 * sigma,
                   from_c=warmth.coldest_c, to_c=warmth.warmest_c)


def _warmth(solution: Solution, evidence: Evidence) -> Warmth | None:
    """Return the temperature of the turns; None where it is not known about all."""
    return Warmth.over(evidence.temperature, [
        scene.tracks.stamps_ns for scene in solution.scenes if scene.turn.of_this_drive])


def _over_time(solution: Solution, evidence: Evidence) -> tuple[CameraAt, ...]:
    """Return the camera at the begin, in the middle and at the end of each turn, if it changes."""
    drift, rows = solution.drift, []
    if drift is None:
        return ()
    stamps = [scene.tracks.stamps_ns for scene in solution.scenes if scene.turn.of_this_drive]
    for stamp_ns in sorted({int(each) for own in stamps for each in (
            own[0], (own[0] + own[-1]) // 2, own[-1])}):
        camera, sigma = solution.at(stamp_ns)
        full, named = _in_input(camera, sigma, solution.px, evidence.image_size)
        rows.append(CameraAt(stamp_ns / 1e9 - evidence.start_s, full.named, named))
    return tuple(rows)


def _part(part: Solution | None, whole: Solution, later: int, evidence: Evidence, config: Config
          ) -> Part:
    """Return what the turns before a step say, or those later, each with its own verdict."""
    assert whole.drift is not None
    step_ns = whole.drift.step_ns or 0
    stamps = [scene.tracks.stamps_ns for scene in whole.scenes if scene.turn.of_this_drive
              and (int(scene.tracks.stamps_ns[0]) >= step_ns) == bool(later)]
    from_s, to_s = (float(pick(each)) / 1e9 - evidence.start_s for pick, each in (
        (min, map(min, stamps)), (max, map(max, stamps))))
    if part is None:
        verdict = Verdict('refused', (
            Notice('E-UNDETERMINED', 'no camera follows from its turns'),))
    else:
        part = replace(part, px=whole.px)
        verdict = judge(part, config.verdict)
    reasons = tuple(map(str, verdict.reasons))
    if part is None or verdict.level == 'refused':
        return Part(from_s, to_s, verdict.level, reasons, verdict.codes, None, None, None)
    full, sigma = _in_input(part.camera, part.sigma, part.px, evidence.image_size)
    return Part(from_s, to_s, verdict.level, reasons, verdict.codes, full.model,
                full.named, sigma, part.picture.times(part.px))


# px RMS; a warning names a field that no lens model has, if it is larger
REPORTED_FIELD_PX = 0.5


def _stamps(times: Times) -> Iterator[Notice]:
    """Yield warnings where stamps do not say when images were taken."""
    if times.frames:
        yield Notice(
            'E-TIME-MISSING', f'images are missing at {counted(len(times.frames), "place")}, '
            f'{times.missing_s:.1f} s in all, the first after frame {min(times.frames)}, and the '
            f'stamps hide it; their time is taken from the speed of the car: record all images, '
            f'or stamp each when it is taken')
    if times.inaccurate_s:
        yield Notice(
            'E-STAMPS-INACCURATE', f'the stamps are inaccurate by '
            f'{1e3 * times.inaccurate_s:.0f} ms (RMS), and the times are taken from the smooth '
            f'motion of the car: stamp each image when it is taken, not when it arrives')


def _warnings(found: CalibrationData, solution: Solution, evidence: Evidence
              ) -> tuple[Notice, ...]:
    """Return what the user must know about the numbers, which does not change the verdict."""
    level, model, field = found.verdict.level, found.config.model, found.field
    warnings = list(_stamps(solution.times))
    if evidence.temperature is not None and _warmth(solution, evidence) is None:
        warnings.append(Notice(
            'E-TEMPERATURE-TIMES', 'the temperature is not used: it was not measured at the times '
            'of all turns; check its time stamps'))
    if level != 'accepted' and model != AUTO:
        warnings.append(Notice(
            'E-MODEL-CHOSEN',
            f'the lens model {model} was chosen by hand and may be why the result is {level}: '
            f'--model {AUTO} uses the one that fits the turns'))
    warnings += [Notice(
        'E-KNOWN-CONTRADICTED',
        f'known.{each.name} is {each.value:.5g}, and the turns say {each.by_turns:.5g} ± '
        f'{each.by_turns_sigma:.2g}: it does not count; correct it, or leave it out')
        for each in found.known if not each.used]
    if found.config.known.height and 'height' not in {each.name for each in found.known}:
        warnings.append(Notice(
            'E-KNOWN-HEIGHT', 'known.height does not count: that needs the speed of the car '
            '(--motion, mount.speed_kmh) and stretches in which the road is seen'))
    if found.config.known.stabiliser == 'no' and not solution.fixed:
        warnings.append(Notice(
            'E-KNOWN-CONTRADICTED',
            'known.stabiliser is no, and the pictures move against the lens as with one: it does '
            'not count; correct it, or leave it out'))
    if field is not None and field.used and field.rms_px >= REPORTED_FIELD_PX:
        warnings.append(Notice(
            'E-FIELD-LARGE',
            f'the picture is bent by {field.rms_px:.1f} px (up to {field.worst_px:.1f} px), as by '
            f'a windscreen or a rectification: camera_info cannot describe this, and sigma over '
            f'the picture includes it; `dashcalib export --to rays` keeps it'))
    share = solution.posterior.rival_share
    if level != 'refused' and share > REPORTED_SHARE:
        warnings.append(Notice(
            'E-PIXELS-SQUARE',
            f'the turns do not decide whether pixels are square: that fy / fx is '
            f'{solution.camera.fy / solution.camera.fx:.3f} is wrong with a probability of '
            f'{100 * share:.0f} %, and sigma of fy contains it'))
    said = {'E-FOCAL-LENGTH-DRIFTS', 'E-FOCAL-LENGTH-STEPS'}.intersection(found.verdict.codes)
    if level != 'refused' and solution.drift is not None and not said:
        drift = found.drift
        how = f'{100 * solution.drift.largest:.2f} % during the drive'
        of = 'the middle of the drive'
        if drift is not None and drift.fx_percent_per_kelvin is not None:
            how = (f'{drift.fx_percent_per_kelvin:+.3f} ± {drift.sigma_per_kelvin:.3f} % per '
                   f'kelvin, from {drift.from_c:.0f} to {drift.to_c:.0f} °C')
            of = f'{found.temperature_c:.1f} °C'
        elif drift is not None:
            how = (f'{drift.from_first_to_last_percent:+.2f} % from the first turn to the last '
                   f'({drift.fx_percent_per_hour:+.1f} ± {drift.sigma:.1f} % an hour), as of a '
                   f'lens that warms up')
        warnings.append(Notice(
            'E-FOCAL-LENGTH-DRIFT', f'the focal length changes by {how}: camera_info is that of '
            f'{of}; `dashcalib export --at` writes that of another time'))
    if found.mount is not None and found.mount.moved_s is not None:
        warnings.append(Notice(
            'E-CAMERA-MOVED',
            f'the camera was moved on the car {found.mount.moved_s - found.start_s:.0f} s into '
            f'the drive: the mounting is that from there on'))
    if (found.stabiliser is not None and crop_matters(solution)
            and 'E-PICTURE-MOVES' not in found.verdict.codes):
        warnings.append(Notice(
            'E-PICTURE-SEEMS-TO-MOVE',
            f'the picture seems to move by up to {found.stabiliser.largest_px:.0f} px against the '
            f'lens, which is within the uncertainty of the lens, and was removed: {STEADY}'))
    return tuple(warnings)


def straight_lines(solution: Solution | None, evidence: Evidence) -> Bend | None:
    """Return what straight lines say about the solution, in the resized images."""
    if solution is None or evidence.lines is None:
        return None
    lines, field = evidence.lines, solution.field
    if field is not None:
        ideal = field.ideal(lines.points.astype(np.float64))
        lines = replace(lines, points=ideal.astype(np.float32))
    return bend(lines, solution.camera, covariance=solution.covariance)


def _mount(solution: Solution, evidence: Evidence, level: str, config: Config) -> Mount | None:
    if evidence.straights is None or not config.mount.enabled:
        return None
    return mount_of(evidence.straights, evidence.lines, solution, level,
                    _speed(evidence, config))


def _height(solution: Solution, evidence: Evidence, config: Config) -> tuple[float, float] | None:
    """Return the height of the camera above the road and its sigma, m; None: not measured."""
    mount = _mount(solution, evidence, 'accepted', config)
    if mount is None or mount.height_m is None:
        return None
    return mount.height_m, mount.sigma['height_m'] or 0.0


# of a speed that a driver reads and keeps, a fraction
CONSTANT_SIGMA = 0.03


def _speed(evidence: Evidence, config: Config) -> Speed | None:
    constant = config.mount.speed_kmh / 3.6
    if constant:
        return Speed(lambda stamps_s: np.full(len(stamps_s), constant), CONSTANT_SIGMA)
    if evidence.motion is None:
        return None
    known = speeds_of(evidence.motion.since(evidence.start_s))
    if known is None:
        return None
    return Speed(lambda stamps_s: np.interp(stamps_s - evidence.start_s, known.stamps_s,
                                            known.values[:, 0], left=0.0, right=0.0),
                 speed_sigma(evidence.motion))


def _of_size(mask: Mask | None, size: tuple[int, int]) -> Mask | None:
    if mask is None:
        return None
    row, column = (np.arange(length) * count // length
                   for length, count in zip(size[::-1], mask.shape, strict=True))
    return np.asarray(mask[np.ix_(row, column)], bool)


def _field(solution: Solution, image_size: tuple[int, int]) -> LensField | None:
    if solution.field is None:
        return None
    px = solution.px
    sizes = px * solution.field.over(solution.camera)
    rms_px, sigma_px = float(np.sqrt(np.mean(sizes**2))), px * solution.rays_sigma_px
    return LensField(solution.field.resized(px, image_size), rms_px >= sigma_px, rms_px,
                     float(sizes.max()), sigma_px)


def _verdict_without_solution(evidence: Evidence, config: VerdictConfig) -> Verdict:
    turns = len(evidence.turns)
    if evidence.frames < 2:
        found = Finding('E-FEW-IMAGES', 'refused',
                        f'the drive has only {counted(evidence.frames, "image")}',
                        'record a drive with turns')
    elif not turns:
        found = Finding('E-NO-TURN', 'refused',
                        'no turn was found: the car stood or drove straight on, or the pictures '
                        'show too little', 'record a drive with turns at crossings, in daylight')
    elif evidence.left_out and set(evidence.left_out.values()) == {STOOD}:
        found = Finding('E-CAR-STOOD', 'refused',
                        f'the car stood during all turns that were found ({turns}), according to '
                        f'its speed',
                        'drive through turns, or omit the speed if it is wrong')
    elif any(turn not in evidence.left_out for turn in evidence.built):
        found = Finding('E-UNDETERMINED', 'refused',
                        'the turns could be reconstructed, but no camera follows from them: '
                        'nothing in them limits the focal length, as where the camera slides past '
                        'flat or distant things', 'drive through turns at crossings, past houses '
                        'and parked cars, near and far')
    else:
        found = Finding('E-NO-SCENE', 'refused',
                        f'{counted(turns, "turn")} {"was" if turns == 1 else "were"} found, but '
                        f'none could be reconstructed: the pictures are too dark or blurred, or '
                        f'the camera turned without moving',
                        'drive through turns at town speed, in daylight')
    other = evidence.other_camera
    verdict = verdict_of([two_cameras(other), found] if other else [found])
    return replace(verdict, conditions=(*verdict.conditions, *(
        each.condition for each in (turn_count((), config), yaw_in_all(0.0, config)))))


def _summary(turn: Turn, scene: Scene | None, evidence: Evidence, solution: Solution | None
             ) -> TurnSummary:
    return TurnSummary(
        center=turn.center, first=turn.first, last=turn.last, stamp_s=turn.stamp_s,
        prominence=turn.prominence, images=len(scene.tracks.frames) if scene else turn.images,
        registered=int(scene.structure.registered.sum()) if scene else 0,
        yaw_deg=scene.yaw_deg if scene else None, right_deg=scene.right_deg if scene else None,
        **_use(turn.id, scene, evidence, solution))


def _stored_summary(turn: StoredTurn, scene: Scene, evidence: Evidence, solution: Solution | None
                    ) -> StoredTurnSummary:
    return StoredTurnSummary(
        id=scene.turn, stamp_s=turn.stamp_s, prominence=turn.prominence,
        yaw_deg=turn.scene.yaw_deg, images=len(scene.tracks.frames), clip=scene.turn.clip,
        **_use(scene.turn, scene, evidence, solution))


def _use(turn: TurnId, scene: Scene | None, evidence: Evidence, solution: Solution | None
         ) -> dict[str, Any]:
    """Return how a turn was used: what both kinds of summary have; errors in the input's px.

    scene: as the solution has it; where it has none, as it was reconstructed.
    """
    used = solution is not None and any(scene is each for each in solution.scenes)
    error = None
    if scene is not None:
        camera = solution.camera if solution and used else scene.camera
        error = rms_px([scene], camera) * evidence.scale.px
    return {'used': used, 'reprojection_error_px': error,
            'misfit': solution.misfits.get(turn) if solution else None,
            'unused_because': None if used else evidence.left_out.get(
                turn, _unused_because(turn, scene, solution))}


def _unused_because(turn: TurnId, scene: Scene | None, solution: Solution | None) -> str:
    if solution is None:
        return ('it was not reconstructed' if scene is None else
                'no camera explains what was seen in it')
    misfit = solution.misfits.get(turn)
    if scene is None or misfit is None:
        return NOT_NEEDED
    return f'{CONTRADICTS}, with {misfit:.1f} times the error of a camera of its own'


def _material(scenes: Mapping[TurnId, Scene], solution: Solution | None, evidence: Evidence
              ) -> Material | None:
    if evidence.pictures is None:
        return None
    pictures = dict(evidence.pictures)
    for turn in evidence.turns:
        picture = None if turn.id in pictures else picture_of(turn, scenes.get(turn.id))
        if picture is not None:
            pictures[turn.id] = picture
    return Material(evidence.scale.px, solution, scenes, pictures)


def _details(solution: Solution) -> dict[str, Any]:
    width = solution.camera.image_size[0]
    details: dict[str, Any] = {
        'step1': {'f_over_width': solution.centred.fx / width,
                  **dict(list(solution.centred.named.items())[4:])},
        'focal_profile': {'f_over_width': solution.around.ratios.tolist(),
                          'cost_px2': solution.around.costs.tolist()},
        'profile_contrast': profile_contrast(solution),
        'turns_disagree_fx': focal_disagreement(solution),
        'fixed_camera': {each.kind: {'strength': each.strength, 'size': each.size}
                         for each in solution.fixed_camera},
        'models': [asdict(candidate) for candidate in solution.tried],
    }
    pictures = solution.by_pictures
    if pictures is not None:
        # what pictures alone say, where a gyro is in the solution
        details['pictures_alone'] = {'fx': solution.px * pictures.camera.fx,
                                     'sigma_fx': solution.px * float(pictures.sigma[0])}
    return details


# result.json has their versions: a result's last digits depend on them
PACKAGES = (
    'dashcalib_ros', 'numpy', 'scipy', 'opencv-python-headless', 'av', 'pycolmap')


def versions(reconstruct: ReconstructConfig) -> dict[str, str]:
    """Return those of PACKAGES, and Python's, by name; and the engine that estimates poses."""
    found = {'python': platform.python_version(), 'engine': reconstruct.used}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = 'not installed'
    return found
