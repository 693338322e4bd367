# SPDX-License-Identifier: Apache-2.0
"""Solution -> verdict: every rule by which a result is refused or called weak.

Registered images and residuals do not separate good solutions from bad ones; the focal profile,
the yaw, the agreement of the turns and the sigmas do. A new rule is a function here and a row in
RULES.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dashcalib_ros.camera import MODELS
from dashcalib_ros.camera.camera import PINHOLE
from dashcalib_ros.config import VerdictConfig
from dashcalib_ros.detect import Bend
from dashcalib_ros.detect.one_camera import APART, OtherCamera
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.errors import Notice, counted, spared
from dashcalib_ros.judge.agreement import (
    MAX_MISFIT,
    focal_disagreement,
    leverages,
    next_turn,
    separate_bends,
    turns_of_another_camera,
)
from dashcalib_ros.judge.calibration import Condition, Level, Verdict, Witnesses
from dashcalib_ros.judge.mount import roll_of_path
from dashcalib_ros.reconstruct.heading import off_axis_deg, roll_deg
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.evidence import (
    HIDDEN_DEG,
    LARGE_FIELD,
    LEAST_GAIN,
    LEAST_KIND_GAIN,
    SMALL_FIELD,
    FixedCameraTest,
    largest_crop,
)
from dashcalib_ros.solve.solution import Solution

# remedies that several rules have
STEADY = 'switch off the stabiliser and fix the zoom, then record another drive'
MORE_TURNS = 'drive more and sharper turns, as at crossings, in daylight'
CORNERS = 'drive where there are things to see up to the corners of the picture'
# the reason for which a camera in use is given up
MOVES = 'E-PICTURE-MOVES'
# for what no camera_info holds
RAYS = 'use `dashcalib export --to rays`'


@dataclass(frozen=True)
class Grounds:
    """What a verdict rests on.

    lines: what straight lines show of the solution; None where there are too few. witnesses: what
    sensors know about it. other_camera: a second one in the same stream.
    """

    solution: Solution
    config: VerdictConfig
    lines: Bend | None = None
    witnesses: Witnesses = field(default_factory=Witnesses)
    other_camera: OtherCamera | None = None


@dataclass(frozen=True)
class Finding:
    """What a rule finds: the verdict it leads to, what is wrong, and what to do.

    code: names what is wrong; it stays when the texts are reworded. level: 'accepted' where
    nothing is wrong. what, remedy: in the words of the driver, with the figures;
    docs/troubleshooting.md explains each. remedy: the likeliest first, and only what can help.
    cause: whether the other findings may come from it; then it is the first one. name, value,
    limit: what was measured, of this drive, and what is needed; '' where no two numbers say it.
    """

    code: str
    level: Level
    what: str
    remedy: str
    cause: bool = False
    name: str = ''
    value: str = ''
    limit: str = ''

    def measured(self, name: str, value: str, limit: str) -> Finding:
        """Return it with the numbers that say it."""
        return replace(self, name=name, value=value, limit=limit)

    @property
    def objects(self) -> bool:
        """Return whether something is wrong."""
        return self.level != 'accepted'

    @property
    def condition(self) -> Condition:
        """Return what the report shows of it."""
        return Condition(self.code, self.name or self.what, self.value, self.limit,
                         not self.objects)


# None where nothing is wrong, and nothing was measured that two numbers say
Rule = Callable[[Grounds], Finding | None]


def judge(solution: Solution, config: VerdictConfig, lines: Bend | None = None,
          outlook: bool = False, witnesses: Witnesses | None = None,
          other_camera: OtherCamera | None = None) -> Verdict:
    """Return the verdict on a solution, its reasons sorted: causes, then those that refuse it.

    lines, witnesses, other_camera: as in Grounds. outlook: whether to predict what one more turn
    would bring, where only knowledge is missing.
    """
    grounds = Grounds(solution, config, lines, witnesses or Witnesses(), other_camera)
    findings = [found for rule in RULES if (found := _found(rule, grounds)) is not None]
    findings.sort(key=lambda found: (not found.objects, found.objects and not found.cause,
                                     found.level != 'refused'))
    if outlook and findings[0].objects and lacks_knowledge_only(grounds):
        first, more = findings[0].remedy, spared('the outlook', [], next_turn, solution) or ''
        findings = [replace(found, remedy=first + (more and f' ({more})')) if found.remedy == first
                    else found for found in findings]
    return verdict_of(findings)


def verdict_of(findings: Sequence[Finding]) -> Verdict:
    """Return the verdict that findings lead to, in their order; without any it is accepted."""
    against = [found for found in findings if found.objects]
    levels = {found.level for found in against}
    return Verdict('refused' if 'refused' in levels else 'weak' if levels else 'accepted',
                   tuple(Notice(found.code, found.what, found.remedy) for found in against),
                   tuple(found.condition for found in findings))


def lacks_knowledge_only(grounds: Grounds) -> bool:
    """Return whether nothing contradicts a solution: where it is weak, its turns know too little.

    Another focal length may explain them as well, but not clearly better.
    """
    found = [_found(rule, grounds) for rule in SOUND]
    return (profile_contrast(grounds.solution) > -MIN_CONTRAST
            and not any(each is not None and each.objects for each in found))


def _found(rule: Rule, grounds: Grounds) -> Finding | None:
    """Return what a rule finds; one that fails costs no result, but that is not accepted."""
    lost: list[Notice] = []
    found = spared(f'the check {rule.__name__.strip("_")}', lost, rule, grounds)
    return Finding('E-CHECK-FAILED', 'weak', str(lost[0]), 'calibrate again with the next release'
                   ) if lost else found


def _graded(refused: bool, weak: bool) -> Level:
    return 'refused' if refused else 'weak' if weak else 'accepted'


# of the sigma of fx by pictures alone; a gyro that knows as much as these leaves 0.71
CONFIRMED = 0.71


def gyro_confirms(solution: Solution) -> bool:
    """Return whether a gyro that agrees knows fx as well as the turns do, or better."""
    pictures, with_gyro = solution.by_pictures, solution.by_turns or solution
    return pictures is not None and bool(with_gyro.sigma[0] <= CONFIRMED * pictures.sigma[0])


def _number_of_turns(grounds: Grounds) -> Finding:
    return turn_count(grounds.solution.scenes, grounds.config, gyro_confirms(grounds.solution))


def turn_count(scenes: Sequence[Scene], config: VerdictConfig, confirmed: bool = False) -> Finding:
    """Judge the number of turns. confirmed: by a gyro, so that one is enough."""
    count = separate_bends(scenes)
    parts = ('' if len(scenes) == count else
             ' (of one bend several stretches count as one turn)')
    lone = ', and nothing confirms its numbers and their sigma' if count == 1 else ''
    return Finding('E-FEW-TURNS', _graded(False, count < config.min_turns and not confirmed),
                   f'only {count} of at least {config.min_turns} turns could be used{parts}{lone}',
                   MORE_TURNS).measured(
        'turns used', f'{count}',
        'the gyro confirms them' if confirmed else f'at least {config.min_turns}')


def _yaw_of_turns(grounds: Grounds) -> Finding:
    found = yaw_in_all(sum(scene.yaw_deg for scene in grounds.solution.scenes), grounds.config)
    # bumps and gentle bends count where no stabiliser can hide them
    return replace(found, level='accepted') if grounds.solution.fixed else found


def yaw_in_all(yaw_deg: float, config: VerdictConfig) -> Finding:
    """Judge the yaw of all turns together: with little of it a result is weak at most."""
    least = config.min_yaw_deg
    return Finding('E-LITTLE-YAW', _graded(False, yaw_deg < least),
                   f'the turns have {yaw_deg:.0f}° of yaw in all, at least {least:.0f}° are '
                   f'needed', MORE_TURNS).measured(
        'yaw of these turns together', f'{yaw_deg:.0f}°', f'at least {least:.0f}°')


def _only_gentle(grounds: Grounds) -> Finding | None:
    """Where nothing but gentle bends was seen, a stabiliser could have made the pictures."""
    scenes = grounds.solution.scenes
    if not only_gentle(grounds.solution):
        return None
    return Finding('E-ONLY-GENTLE', 'weak',
                   f'nothing but gentle bends and straight stretches was seen ({len(scenes)}), '
                   f'and a stabilised video would look the same',
                   'drive a turn at a crossing, or say --known stabiliser=no where the camera has '
                   'no stabiliser')


def only_gentle(solution: Solution) -> bool:
    """Return whether a stabiliser could have made all that was seen."""
    return bool(solution.scenes) and all(scene.turn in solution.perhaps_shifted
                                         for scene in solution.scenes)


# relative rise of the error with fx 20 % off; less is weak, and less is refused
MIN_CONTRAST, REFUSED_CONTRAST = 0.05, 0.01


def flat_profile(grounds: Grounds) -> Finding:
    """The cost must rise on both sides of its minimum, or the focal length is not observable."""
    contrast = profile_contrast(grounds.solution)
    # of gentle bends the sigma says how well it is known; the profile may only not contradict it
    refused = REFUSED_CONTRAST if _has_turn(grounds.solution) else -MIN_CONTRAST
    least = 0.0 if _sigma_decides(grounds.solution) else MIN_CONTRAST
    percent = 100 * (contrast if least == 0.0 else max(contrast, 0.0))
    return Finding(
        # written with not: a contrast of NaN is refused, too
        'E-FLAT-PROFILE', _graded(not contrast >= refused, contrast < least),
        f'a focal length 20 % off would explain the pictures better (the error falls by '
        f'{-percent:.1f} %)' if percent < 0.0 else
        f'a focal length 20 % off would explain the pictures almost as well (the error rises by '
        f'{percent:.1f} %, at least {100 * least:.0f} % is needed)',
        MORE_TURNS).measured('rise of the error when the focal length is 20 % off',
                             f'{percent:.1f} %', f'at least {100 * least:.0f} %')


def _has_turn(solution: Solution) -> bool:
    return any(scene.yaw_deg >= HIDDEN_DEG for scene in solution.scenes)


def _sigma_decides(solution: Solution) -> bool:
    """Return whether nothing but gentle stretches was seen, and no stabiliser shifted them."""
    return solution.fixed and not _has_turn(solution)


def profile_contrast(solution: Solution) -> float:
    """Return the relative rise of the cost from the result to the lowest of the other probes.

    The result is the camera that the turns give, before what somebody knew moved it.
    """
    camera = (solution.by_turns or solution).camera
    return solution.around.contrast(camera.fx / camera.image_size[0])


def _far_from_profile(grounds: Grounds) -> Finding | None:
    solution = grounds.solution
    if profile_contrast(solution) >= (0.0 if _has_turn(solution) else -MIN_CONTRAST):
        return None
    best = solution.around.best * solution.camera.image_size[0]
    return Finding('E-TWO-FOCAL-LENGTHS', 'refused',
                   f'two ways to find the focal length contradict each other, as where other '
                   f'traffic fills the pictures: {solution.px * solution.camera.fx:.0f} px and '
                   f'about {solution.px * best:.0f} px',
                   'record another drive, with sharper turns and less traffic')


# sigma of fx, of fx; more is refused
REFUSED_SIGMA = 0.1


def sigma_too_large(grounds: Grounds) -> Finding:
    """Fx must be known well enough; an unknown sigma is refused, too."""
    sigma, most = _relative_sigma(grounds.solution), grounds.config.max_sigma
    known = f'only to {100 * sigma:.1f} %' if np.isfinite(sigma) else 'not at all'
    return Finding(
        'E-LARGE-SIGMA', _graded(not np.isfinite(sigma) or sigma > REFUSED_SIGMA, sigma > most),
        f'the focal length is known {known}, {100 * most:.1f} % or better is needed',
        MORE_TURNS).measured('uncertainty of fx', f'{100 * sigma:.2g} %',
                             f'at most {100 * most:.3g} %')


def _relative_sigma(solution: Solution) -> float:
    return float(solution.sigma[0] / solution.camera.fx)


def one_turn_dominates(grounds: Grounds) -> Finding | None:
    """If one turn gives nearly all information about fx, the others cannot confirm it.

    Of a single turn the rule on the number of turns says all.
    """
    shares, most = leverages(grounds.solution), grounds.config.max_leverage
    if len(shares) < 2:
        return None
    turn = max(shares, key=lambda turn: shares[turn])
    percent, confirmed = 100 * min(shares[turn], 1.0), gyro_confirms(grounds.solution)
    return Finding('E-ONE-TURN-DOMINATES',
                   _graded(False, shares[turn] > most and not confirmed),
                   f'no other turn confirms {_turns([turn])}, which gives {percent:.0f} % of the '
                   f'information about the focal length',
                   'drive another turn that is as sharp').measured(
        'largest share of one turn in the information about fx', f'{percent:.0f} %',
        'the gyro confirms it' if confirmed else f'at most {100 * most:.0f} %')


# weighted scatter of fx between turns, of fx; more is weak
MAX_DISAGREEMENT = 0.03


def turns_disagree(grounds: Grounds) -> Finding:
    """Compare the values of fx that the turns would give separately."""
    # each gentle stretch alone knows fx to a few percent: such scatter is no disagreement
    spread = focal_disagreement(grounds.solution, _sigma_decides(grounds.solution))
    most = MAX_DISAGREEMENT
    return Finding('E-TURNS-DISAGREE', _graded(False, spread > most),
                   f'the turns disagree about the focal length by {100 * spread:.1f} %, at most '
                   f'{100 * most:.0f} % is usual',
                   'record another drive with little traffic, and make sure that nobody zooms or '
                   'moves the camera').measured(
        'scatter of fx between the turns', f'{100 * spread:.2g} %', f'at most {100 * most:.3g} %')


def other_camera(grounds: Grounds) -> Finding:
    """No turn may fit a camera of its own far better than the common one.

    Gentle stretches have nothing but their agreement: a highway's traffic made one 9 % wrong.
    """
    misfits = grounds.solution.misfits
    turns = sorted(turns_of_another_camera(misfits))
    gentle = only_gentle(grounds.solution)
    return Finding('E-ANOTHER-CAMERA', _graded(bool(turns) and gentle, bool(turns)),
                   f'{_turns(turns)} fit{"s" * (len(turns) == 1)} another camera far better than '
                   f'that of the other turns, as if the camera was zoomed, exchanged or cropped '
                   f'in between',
                   'calibrate the parts before and after that change separately').measured(
        'error of a turn, over that with a camera of its own',
        f'{max(misfits.values(), default=0.0):.2g} times',
        f'at most {MAX_MISFIT:.2g} times')


# clips in a message
NAMED = 3


def _turns(turns: list[TurnId]) -> str:
    own = [str(turn.number) for turn in turns if turn.of_this_drive]
    stored = Counter(turn.clip or 'earlier drives' for turn in turns if not turn.of_this_drive)
    names = []
    if own:
        names.append(f'the turn{"s" * (len(own) > 1)} at frame {", ".join(own)}')
    if len(stored) > NAMED:
        names.append(f'{counted(stored.total(), "turn")} of {len(stored)} clips')
    else:
        names += [f'{counted(count, "turn")} of {where}' for where, count in stored.items()]
    return ' and '.join(names)


# of the width, root mean square; less is not a movement: KITTI 07, a fixed camera, has 0.002 at
# one of two rates, and a crop that wanders by 0.01 has 0.0045 to 0.0095
LEAST_MOVE = 0.003


def crop_matters(solution: Solution) -> bool:
    """Return whether a crop moved by so much that it may be no error of a fixed picture."""
    if not solution.crops:
        return False
    paths = np.concatenate(list(solution.crops.values()))
    typical = np.sqrt(np.mean(np.sum((paths - np.median(paths, axis=0))**2, axis=1)))
    return bool(typical > LEAST_MOVE * solution.camera.image_size[0])


def _not_fixed(grounds: Grounds) -> Finding | None:
    """Name what no fixed camera does.

    A stabilised video's movement may have been taken out. The lens is right then, but no
    camera_info holds for pictures that move.
    """
    solution = grounds.solution
    known = _relative_sigma(solution)
    # a zoom that is smaller than what is known about the focal length is none
    clear = [each for each in solution.fixed_camera
             if each.clear and not (each.kind == 'zoom' and each.size < known)]
    crop = largest_crop(solution.crops) if crop_matters(solution) else 0.0
    if crop > grounds.config.max_crop_sigmas * solution.picture.rms:
        return _moving('up to', crop, solution)
    if not clear:
        return None
    if clear[0].kind == 'shift':
        return _moving('about', clear[0].size, solution)
    if clear[0].kind == 'bend':
        return Finding('E-PICTURE-BENT', 'weak',
                       f'the picture is bent in places, in a way that the lens model '
                       f'{solution.camera.model} cannot describe',
                       f'{RAYS}, which includes the smooth part of it'
                       if solution.field is not None else
                       'clean the lens and the glass in front of it, then record another drive')
    return Finding('E-ZOOM-CHANGES', 'weak', _zoomed(clear[0]),
                   'fix the zoom and the focus, then record another drive')


# of the focal length; a smaller step does not affect the verdict
LEAST_STEP = 0.003


def _drifts(grounds: Grounds) -> Finding | None:
    """No camera_info is right for a focal length that changes by more than fx may be off."""
    drift, most = grounds.solution.drift, 2 * grounds.config.max_sigma
    if drift is None:
        return None
    step_ns, largest = drift.step_ns, drift.largest
    if step_ns is None:
        found = Finding('E-FOCAL-LENGTH-DRIFTS', _graded(False, largest > most),
                        f'the focal length changes by {100 * largest:.1f} % during the drive',
                        'use intrinsics_at of result.json: `dashcalib export --at`; or fix the '
                        'zoom and the focus')
    else:
        most = LEAST_STEP
        own = sorted((int(scene.tracks.stamps_ns[0]), scene.turn) for scene
                     in grounds.solution.scenes if scene.turn.of_this_drive)
        before, after = ([turn for stamp_ns, turn in own if (stamp_ns >= step_ns) == later]
                         for later in (False, True))
        found = Finding('E-FOCAL-LENGTH-STEPS', _graded(False, largest > most),
                        f'the focal length steps by {100 * drift.size:+.1f} % between '
                        f'{_turns(before[-1:])} and {_turns(after[:1])}, as if somebody had '
                        f'touched the lens',
                        'use the two calibrations in parts of result.json: `dashcalib export '
                        '--at`')
    return found.measured('change of the focal length during the drive', f'{100 * largest:.2f} %',
                          f'at most {100 * most:.3g} %')


def _moving(how: str, px: float, solution: Solution) -> Finding:
    share = 100 * px / solution.camera.image_size[0]
    return Finding('E-PICTURE-MOVES', 'weak',
                   f'the picture moves against the lens by {how} {share:.1f} % of its width, as '
                   f'in a stabilised video or while the zoom changes, so no single camera_info is '
                   f'right for all pictures', STEADY, cause=True)


# s; stamps that are not nearer to a whole number of steps were measured
EVEN_S = 1e-6


def _uneven_times(grounds: Grounds) -> Finding | None:
    """Name the other cause of a picture that moves: a rolling shutter, and times that are assumed.

    A row is seen later than the first one, and how far the picture moves until then is wrong where
    the time between two pictures is. Without a rolling shutter wrong times move nothing.
    """
    solution, other = grounds.solution, _not_fixed(grounds)
    if not solution.rolling or other is None or other.code != 'E-PICTURE-MOVES':
        return None
    for scene in solution.scenes:
        seconds = np.diff(scene.tracks.stamps_ns) / 1e9
        step = float(seconds.min())
        if np.any(np.abs(seconds - step * np.rint(seconds / step)) > EVEN_S):
            return None
    return Finding('E-TIMES-ASSUMED', 'weak',
                   f'the images may not have been taken at even times, as theirs are '
                   f'({1e3 * step:.4g} ms apart): with a rolling shutter, a picture whose time is '
                   f'wrong seems to move, too',
                   'use their true times: a video or a bag as it was recorded; in a folder of '
                   'images times.txt, with a line for each image')


def _zoomed(test: FixedCameraTest) -> str:
    zooms = test.by_turn
    larger = sorted(turn for turn, zoom in zooms.items() if zoom > np.mean(list(zooms.values())))
    apart = max(zooms.values()) - min(zooms.values())
    if apart < test.size:
        return f'the zoom changes from image to image, by about {100 * test.size:.1f} %'
    return (f'the zoom changes by about {100 * apart:.1f} %, it is larger in {_turns(larger)} '
            f'than in the others')


# where the road is in turned pictures, by quarters of a turn, and ffmpeg's filter against it
TURNED = {1: ('right side', 'transpose=1'), -1: ('left side', 'transpose=2'),
          2: ('top', 'hflip,vflip'), -2: ('top', 'hflip,vflip'), 0: ('bottom', 'rotate=RADIANS')}
# degrees; the plane of a path of upright pictures is tilted by less, also on a slope
LEAST_PATH_ROLL_DEG = 45.0


def _turned_pictures(grounds: Grounds) -> Finding | None:
    """A car turns about the vertical, and the road is below it.

    The plane of the path of turns of enough yaw must agree.
    """
    scenes = grounds.solution.scenes
    paths = [abs(roll) for scene in scenes if (roll := roll_of_path(scene)) is not None]
    roll = roll_deg(scenes)
    if roll is None or not paths:
        return None
    quarters = round(roll / 90)
    # the plane of a path has no upper side: of pictures upside down it says 0
    agrees = abs(quarters) != 1 or np.median(paths) > LEAST_PATH_ROLL_DEG
    if abs(roll) <= grounds.config.max_roll_deg or not agrees:
        return None
    where, turn = TURNED[quarters]
    return Finding('E-TURNED-PICTURES', 'weak',
                   f'the pictures are rotated by about {abs(roll):.0f}°: the road is at their '
                   f'{where}',
                   f'turn them upright (a video: ffmpeg -i IN -vf {turn} OUT.mp4), or use --set '
                   f'verdict.max_roll_deg=180 for a camera that is mounted this way',
                   cause=True)


# degrees; the medians of 82 rendered drives are 11 at most, turns of three real ones have 1 to 21,
# a car that turns on the spot has 90
MAX_OFF_AXIS_DEG = 60.0


def _moves_sideways(grounds: Grounds) -> Finding:
    """A car drives where it points; what turns on the spot shows the depth of points badly."""
    angle = float(np.median([off_axis_deg(scene) for scene in grounds.solution.scenes]))
    return Finding('E-MOVES-SIDEWAYS', _graded(angle > MAX_OFF_AXIS_DEG, False),
                   f'the camera moves at {angle:.0f}° to its axis in the turns, as where a car '
                   f'turns on the spot: its focal length cannot be determined from that',
                   'drive through turns at town speed, with the camera looking ahead or back',
                   cause=True).measured('angle between the axis of the camera and its motion',
                                        f'{angle:.0f}°', f'at most {MAX_OFF_AXIS_DEG:.0f}°')


def _strange_aspect(grounds: Grounds) -> Finding | None:
    """A rolling shutter that was not removed changes fy first; so does a stretched picture."""
    camera = grounds.solution.camera
    aspect = camera.fy / camera.fx
    if abs(aspect - 1) <= grounds.config.max_aspect:
        return None
    brown = '' if camera.model != 'radial' else ', or try --model brown'
    return Finding('E-PIXEL-ASPECT', 'weak',
                   f'fy is {100 * (aspect - 1):+.1f} % off fx, as with stretched pictures, a '
                   f'decentred lens or a strong rolling shutter',
                   f'check the time stamps (--fps), by which a rolling shutter is found, and undo '
                   f'any stretching of the pictures{brown}')


# ms; a rolling shutter that takes longer is weak: one picture at 20 fps
MAX_READOUT_MS = 50.0


def _strange_shutter(grounds: Grounds) -> Finding | None:
    readout_ms = 1e3 * abs(grounds.solution.readout_s)
    if not grounds.solution.rolling or readout_ms <= MAX_READOUT_MS:
        return None
    return Finding('E-LONG-READOUT', 'weak',
                   f'reading out the rows of a picture seems to take {readout_ms:.0f} ms, longer '
                   f'than rolling shutters take', 'check the time stamps, or --fps')


# of the range between its bounds; a parameter nearer to one of them counts as lying on it
ON_BOUND = 0.01


def _on_bound(grounds: Grounds) -> Finding | None:
    (low, high), camera = grounds.solution.bounds, grounds.solution.camera
    share = (camera.params - low) / (high - low)
    names = [name for name, value in zip(camera.names(), share, strict=True)
             if not ON_BOUND < value < 1 - ON_BOUND]
    if not names:
        return None
    return Finding('E-PARAMETER-LIMIT', 'weak',
                   f'the search for {", ".join(names)} ended at the limit of real lenses',
                   'use the whole picture, not a part of it, or record another drive; mirrors and '
                   'lenses wider than 190° cannot be calibrated')


# sigmas of the rays over the picture; real and rendered drives have up to 0.35
MAX_LAST_STEP = 0.5


def _not_converged(grounds: Grounds) -> Finding | None:
    last = grounds.solution.unsettled
    if last <= MAX_LAST_STEP:
        return None
    return Finding('E-NOT-CONVERGED', 'weak',
                   f'the search for the camera did not come to rest: its last step moved the '
                   f'picture by {last:.1f} sigma', MORE_TURNS)


def _folds_over(grounds: Grounds) -> Finding | None:
    camera = grounds.solution.camera
    if camera.covers_picture():
        return None
    fisheye = '' if camera.family != PINHOLE else (
        ', or try --model fisheye for a wide lens')
    return Finding('E-FOLDS-OVER', 'weak',
                   'the distortion folds over near the corners of the picture, which no real lens '
                   'does: no point was seen there', f'{CORNERS}{fisheye}')


# over the picture; a model that was chosen by hand, but farther from what turns choose, is weak
MAX_MODEL_SIGMAS = 2.0


def _other_model(grounds: Grounds) -> Finding | None:
    """Compare a model that was chosen by hand with what the turns would have chosen."""
    solution = grounds.solution
    by_hand, px = solution.camera, solution.px
    chosen = next((each for each in solution.tried if each.chosen), None)
    if chosen is not None and MODELS[chosen.model].family != by_hand.family:
        apart_px = next((each.apart_px for each in solution.tried if each.model == by_hand.model),
                        None)
        far = 'far' if apart_px is None else f'{px * apart_px:.1f} px'
    elif solution.written.apart_px > MAX_MODEL_SIGMAS * solution.rays_sigma_px:
        chosen, far = None, f'{px * solution.written.apart_px:.1f} px'
    else:
        return None
    other = f'the lens model {chosen.model}' if chosen else 'a lens model with more coefficients'
    return Finding('E-ANOTHER-MODEL', 'weak',
                   f'{other} fits the turns better than {by_hand.model} does, and the two are '
                   f'{far} apart', 'omit --model')


# over the picture; kinds of lenses that differ by less may be mistaken
MAX_KIND_SIGMAS = 10.0


def _other_kind(grounds: Grounds) -> Finding | None:
    """Doubt a lens that explains the turns hardly better than one of the other kind.

    A fisheye must explain them far better, as a pinhole has the same number of coefficients; not
    where it leaves nothing, and the pinhole folds over even behind a windscreen.
    """
    solution, camera = grounds.solution, grounds.solution.camera
    sound = any(each.chosen and each.field < SMALL_FIELD and not each.folds
                for each in solution.tried)
    for each in solution.tried:
        if MODELS[each.model].family == camera.family:
            continue
        if sound and each.folds and each.field > LARGE_FIELD and each.loses_by > LEAST_GAIN:
            continue
        if camera.family == PINHOLE and each.loses_by > LEAST_GAIN:
            continue
        alike_px = MAX_KIND_SIGMAS * solution.picture.rms
        far = each.apart_px is None or each.apart_px > alike_px
        if far and each.cost_ratio < 1 + LEAST_KIND_GAIN:
            return Finding('E-LENS-AMBIGUOUS', 'weak',
                           f'the turns do not show whether the lens is {camera.model} or '
                           f'{each.model}, and these differ near the corners', CORNERS)
    return None


# of the width; only if that k1 moves the picture by more: less does no harm
MAX_LINE_MOVE = 0.001


def lines_contradict(lines: Bend, width: int, config: VerdictConfig) -> bool:
    """Return whether straight lines contradict a camera of pictures of this width, px."""
    return (lines.sigmas > config.max_line_sigmas
            and lines.picture_px / width > MAX_LINE_MOVE)


def _lines_disagree(grounds: Grounds) -> Finding | None:
    """Poles and the edges of houses must be straight: nothing of this comes from motion."""
    lines, solution = grounds.lines, grounds.solution
    if lines is None or not lines_contradict(lines, solution.camera.image_size[0],
                                             grounds.config):
        return None
    glass = '' if solution.field is None else f', or {RAYS} if a curved windscreen bends them'
    return Finding('E-LINES-BENT', 'weak',
                   f'poles and the edges of houses are not straight with this distortion '
                   f'({lines.lines} upright lines: {lines.change}, {lines.sigmas:.0f} sigma; that '
                   f'bends the picture by {solution.px * lines.picture_px:.1f} px)',
                   f'{MORE_TURNS}{glass}')


def _sensors_disagree(grounds: Grounds) -> Finding | None:
    """A gyro and GPS know the angles of the turns, and so the focal length, without pictures."""
    witnesses = grounds.witnesses
    for name, witness in (('the gyro', witnesses.gyro), ('GPS', witnesses.gps)):
        if witness is not None and not witness.agrees:
            return Finding('E-SENSOR-CONTRADICTS', 'weak',
                           f'the pictures and {name} contradict each other: according to {name} '
                           f'the focal length is off by {witness.fx_percent:+.1f} ± '
                           f'{witness.fx_sigma_percent:.1f} %, and the pictures know it to '
                           f'{100 * _relative_sigma(grounds.solution):.1f} %',
                           'check the scale and the clock of the sensor and that it belongs to '
                           'this drive; omit it if it is wrong, otherwise drive more turns')
    return None


def _two_cameras(grounds: Grounds) -> Finding | None:
    return None if grounds.other_camera is None else two_cameras(grounds.other_camera)


def two_cameras(found: OtherCamera) -> Finding:
    """Refuse a stream of two cameras: a calibration of one would be used for both."""
    return Finding('E-TWO-CAMERAS', 'refused', str(found), APART, cause=True)


# whether the turns know enough: where they do not, a fleet's prior may help
ENOUGH: tuple[Rule, ...] = (
    _number_of_turns, _yaw_of_turns, flat_profile, _far_from_profile, sigma_too_large,
    one_turn_dominates, _only_gentle)
# whether anything contradicts the result
SOUND: tuple[Rule, ...] = (
    turns_disagree, other_camera, _not_fixed, _drifts, _uneven_times, _strange_aspect,
    _strange_shutter, _on_bound, _not_converged, _folds_over, _other_model, _other_kind,
    _moves_sideways, _turned_pictures, _lines_disagree, _sensors_disagree, _two_cameras)
RULES = (*ENOUGH, *SOUND)
