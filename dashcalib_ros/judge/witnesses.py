# SPDX-License-Identifier: Apache-2.0
"""What a gyro and GPS know about a solution: the angles of the turns, without any picture.

A turn's angle by the pictures depends on the focal length; by a gyro it does not. The model: from
keyframe to keyframe the camera turned by phi, in its own axes; the sensor by theta, in its axes,
read at the keyframes' stamps plus the time offset. With A the rotation from the sensor to the
camera, b the sensor's bias and s its scale,

    phi = A (theta - b dt) / s

All turns share A, b, s, the offset and the pace of the clocks, by which the offset changes with
time: it has a prior, and several turns measure it. They are found by generalised least squares: a
gyro's noise adds up along a turn, that of the poses is of each keyframe alone, and how large each
is the residuals say. How phi follows the camera's parameters is known from the solution's own
normal equations: so a scale becomes a focal length.

GPS has headings on the straights before and after a turn: the angle between them, with neither
bias nor scale.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.config import Config
from dashcalib_ros.errors import Notice, one_line
from dashcalib_ros.input.motion import Samples, SensorStream, zone_text
from dashcalib_ros.input.poses import Poses
from dashcalib_ros.judge.calibration import Witness, Witnesses
from dashcalib_ros.judge.clocks import (
    LARGEST_OFFSET_S,
    MADE_S,
    PACE,
    Path,
    clock,
    of_steps,
    offset_of,
    paths_of,
)
from dashcalib_ros.judge.gyro_scale import (
    FIXES,
    HEADING_SIGMA_DEG,
    JUMP,
    LEAST_NOISE_M,
    LONGEST_GAP_S,
    SCALES,
    Straight,
    scale_by_gps,
    straight_between,
)
from dashcalib_ros.problem.blocks import lens_alone
from dashcalib_ros.problem.normal import normal_equations
from dashcalib_ros.problem.observations import main_axis
from dashcalib_ros.problem.steps import State
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.robust import weighted_mean
from dashcalib_ros.solve.optimise import loss_px_of
from dashcalib_ros.solve.solution import Solution, with_measurement


@dataclass(frozen=True)
class SensorComparison:
    """A drive's sensors beside its solution by pictures.

    solution: with what the gyro knows. unused: a line for each sensor that is not used.
    """

    solution: Solution | None = None
    witnesses: Witnesses = field(default_factory=Witnesses)
    unused: tuple[Notice, ...] = ()


# minimum number of keyframes of a turn
LEAST_KEYFRAMES = 5


def compare_sensors(solution: Solution | None, stream: SensorStream | None, start_s: float,
                    config: Config) -> SensorComparison:
    """Compare a drive's sensors with its solution. start_s: stamp of the drive's first image.

    Where the gyro's scale is known well enough its angles are information, too; that loads COLMAP.
    """
    if stream is None:
        return SensorComparison(solution)
    stream = stream.since(start_s)
    if stream.empty:
        return SensorComparison(solution, unused=stream.warnings)
    if solution is None:
        unused = [name for kind, name in (('rate', 'gyro'), ('position', 'GPS'))
                  if kind in stream.kinds]
        return SensorComparison(unused=(*stream.warnings, *(Notice(
            'E-SENSOR-NO-TURNS', f'the {name} is not used: no turn could be reconstructed that it '
            f'could be compared with') for name in unused)))
    scenes = [scene for scene in solution.scenes if scene.turn.of_this_drive]
    gyro = gps = odometry = informed = None
    late_s = 0.0
    notices: list[Notice | None] = list(stream.warnings)
    try:
        loss_px = loss_px_of(solution.scenes, solution.camera, config.intrinsics)
        turns = [steps for scene in scenes
                 if len(scene.observed.keyframes) >= LEAST_KEYFRAMES
                 and (steps := steps_of(scene, solution, loss_px, start_s)) is not None]
        apart = {kind: words for kind, samples in stream.kinds.items()
                 if (words := _apart(samples, turns))}
        own, doubt_s = None, stream.doubt_s
        if stream.rate is not None and doubt_s and turns:
            late_s = _late_s(turns, stream.rate, doubt_s)
            stream = stream.shifted(-late_s)
        if stream.rate is not None:
            fit = fit_to(turns, stream.rate)
            own = _own_scale(stream.rate, stream.position, config.motion.gyro_scale_sigma)
            fit = None if fit is None else fit.scaled(own.scale)
            gyro, notice = _gyro(fit, solution, own, apart.get('rate', ''))
            if gyro is not None:
                doubt_s = 0.0
            notices += [own.contradiction, notice]
            if fit is not None and gyro is not None and gyro.agrees:
                informed, notice = _informed(solution, fit, own, config)
                notices.append(notice)
        if stream.position is not None:
            gps, notice = _gps(turns, stream.position, solution, apart.get('position', ''),
                               doubt_s)
            # it has its use where it tells the gyro's scale
            notices.append(None if own is not None and own.by_gps else notice)
        if turns and not doubt_s:
            paths = paths_of(scenes, start_s)
            odometry = _clock_of(stream.speed, stream, gyro, paths)
            by_fixes = _clock_of(stream.position, stream, gyro, paths)
            gps = gps.timed(by_fixes) if gps and by_fixes else gps or by_fixes
        if 'speed' in apart:
            notices.append(Notice('E-SPEED-NO-SAMPLES', f'the speed is not used: it has no '
                                  f'samples during the turns, {apart["speed"]}'))
    except Exception as error:
        notices.append(Notice(
            'E-SENSORS-NOT-COMPARED',
            f'the motion sensors could not be compared with the turns ({one_line(error)})'))
    kept = solution if informed is None or (gps is not None and not gps.agrees) else informed
    return SensorComparison(kept, Witnesses(*(
        each and each.later(late_s) for each in (gyro, gps, odometry))),
        tuple(filter(None, notices)))


def _clock_of(samples: Samples | None, stream: SensorStream, gyro: Witness | None,
              paths: Sequence[Path]) -> Witness | None:
    """Return the clock of positions or of speeds; None where the turns do not tell."""
    if samples is None:
        return None
    alike = stream.rate is not None and bool(np.isin(
        samples.stamps_s, stream.rate.stamps_s).mean() > ONE_CLOCK)
    return offset_of(paths, samples, gyro if alike else None)


# share of samples with the stamps of another sensor; with more they are of the same clock
ONE_CLOCK = 0.9


@dataclass(frozen=True)
class _OwnScale:
    """A gyro's angles over the true ones, without any picture, and the sigma.

    by_gps: what the headings of GPS alone say, where they do. contradiction: of them and of
    gyro_scale_sigma, in a line.
    """

    scale: float
    sigma: float
    by_gps: tuple[float, float] | None = None
    contradiction: Notice | None = None


# sigmas; where a witness is farther off, it contradicts
CONTRADICTED = 3.0


def _own_scale(rate: Samples, position: Samples | None, prior: float) -> _OwnScale:
    found = None if position is None else scale_by_gps(rate, position)
    if found is None:
        return _OwnScale(1.0, prior)
    scale, sigma = found
    if abs(scale - 1) > CONTRADICTED * np.hypot(sigma, prior):
        return _OwnScale(scale, sigma, found, Notice(
            'E-GYRO-SCALE',
            f'the angles of the gyro are {scale:.4f} ± {sigma:.4f} times those of GPS headings, '
            f'and this scale is used: set motion.gyro_scale_sigma, {prior:g}, higher'))
    share = prior**2 / (prior**2 + sigma**2)
    return _OwnScale(1 + share * (scale - 1), sigma * float(np.sqrt(share)), found)


# the same for one turn, which a gyro alone confirms: farther off, it confirms nothing. Of gyros
# that are 3 % wrong and called calibrated, 2 sigmas let 12 of 80 pass, and these none
DOUBTED = 1.25
# sigma of a gyro's scale; one that is known worse is a witness only: a gyro that is 3 % off, and
# does not say so, must not move an accepted camera
KNOWN_SCALE = 0.015


def _informed(solution: Solution, fit: Fit, gyro: _OwnScale, config: Config
              ) -> tuple[Solution | None, Notice | None]:
    """Return the solution with the gyro's angles as information, or None and why not, if at all.

    They are one more measurement of the camera's parameters (a Kalman update); then the turns'
    poses and points are adjusted anew with the camera that it leads to.
    """
    from dashcalib_ros.solve.start import scene_with
    along = solution.covariance @ fit.by_camera
    own = float(fit.by_camera @ along)
    known = float(fit.covariance[6, 6]) + gyro.sigma**2
    if config.motion.use != 'information' or gyro.sigma > KNOWN_SCALE:
        return None, None
    apart = abs(1 - fit.gyro.inverse_scale) / float(np.sqrt(own + known))
    if len(solution.scenes) == 1 and apart > DOUBTED:
        return None, Notice(
            'E-GYRO-UNCONFIRMED',
            f'the gyro does not confirm the only turn, it is {apart:.1f} sigmas off: check its '
            f'scale, its clock and that it belongs to this drive')
    moved = with_measurement(solution, fit.by_camera @ solution.written.by_solution,
                             1 - fit.gyro.inverse_scale, known)
    scenes = [scene_with(moved.camera, scene, config) for scene in solution.scenes]
    if any(scene is None for scene in scenes):
        return None, None
    return replace(moved, by_pictures=solution, scenes=tuple(
        scene for scene in scenes if scene is not None)), None


# of the squared angles; a sensor that explains less is of another drive, or its clock is
LEAST_EXPLAINED = 0.9
# times ours; a scale farther off than SCALES, and in between, is one of units
DEGREES = (40.0, 80.0)


def _apart(samples: Samples, turns: Sequence[Steps]) -> str:
    first_s, last_s = float(samples.stamps_s[0]), float(samples.stamps_s[-1])
    begin_s = min((float(turn.stamps_s[0]) for turn in turns), default=first_s)
    end_s = max((float(turn.stamps_s[-1]) for turn in turns), default=last_s)
    if first_s < end_s and last_s > begin_s:
        return ''
    where = (f'they begin {first_s - end_s:.0f} s after the last turn' if first_s >= end_s else
             f'they end {begin_s - last_s:.0f} s before the first turn')
    return f'{where}{zone_text(first_s, last_s, begin_s, end_s) or ": check their clock"}'


def _late_s(turns: Sequence[Steps], rate: Samples, doubt_s: float) -> float:
    """Return about how late a gyro's stamps are, where no more is known than doubt_s."""
    angles, tried = rate.integral, np.arange(-doubt_s, doubt_s + COARSE_S, COARSE_S)
    return float(min(tried, key=lambda offset: _aligned(turns, angles, float(offset))[0]))


def _gyro(fit: Fit | None, solution: Solution, own: _OwnScale, apart: str
          ) -> tuple[Witness | None, Notice | None]:
    """Return what the gyro says, or why it says nothing. apart: as _apart() has it."""
    if fit is None and apart:
        return None, Notice('E-GYRO-NO-SAMPLES', f'the gyro is not used: it has no samples '
                            f'during the turns, {apart}')
    if fit is None:
        return None, Notice(
            'E-GYRO-TURNS-LITTLE', f'the gyro is not used: the car turns less than '
            f'{LEAST_TURNED_DEG:g} degrees where it has samples: record it without gaps, in turns')
    gyro = fit.gyro
    if abs(gyro.offset_s) >= LARGEST_OFFSET_S or not fit.explained >= LEAST_EXPLAINED:
        return None, Notice(
            'E-GYRO-OTHER-MOTION',
            f'the gyro is not used: it does not turn as the pictures do (it explains '
            f'{100 * max(fit.explained, 0.0):.0f} % of their turning): check that it belongs to '
            f'this drive, and that its time stamps are within 0.5 s of those of the pictures')
    if not SCALES[0] < fit.scale < SCALES[1]:
        remedy = ('write rad/s, not degrees per second' if DEGREES[0] < fit.scale < DEGREES[1] else
                  'check its unit')
        return None, Notice(
            'E-GYRO-UNIT', f'the gyro is not used: its angles are {fit.scale:.3g} times those of '
            f'the pictures: {remedy}')
    if fit.out_of_pace:
        return None, Notice(
            'E-GYRO-CLOCK',
            f'the gyro is not used: its time stamps and those of the pictures do not keep pace '
            f'({fit.out_of_pace}): check --fps, and whether images are missing')
    sigmas = np.sqrt(np.diag(fit.covariance))
    witness = _witness(gyro.inverse_scale, float(sigmas[6]), own.sigma, fit.by_camera, solution)
    return replace(
        witness.timed(clock(gyro.offset_s, float(sigmas[7]), gyro.pace, float(sigmas[8]))),
        camera_from_sensor=tuple(tuple(row) for row in gyro.alignment.tolist()),
        alignment_sigma_deg=float(np.degrees(np.sqrt(np.trace(fit.covariance[:3, :3])))),
        bias_rad_s=tuple(gyro.bias.tolist()), scale_by_gps=own.by_gps), None


def _witness(inverse_scale: float, sigma: float, own_sigma: float, by_camera: Floats,
             solution: Solution) -> Witness:
    """Return a witness. own_sigma: what the sensor's own scale may be off.

    Of all cameras that make up for the scale the likeliest is named, given what turns know.
    """
    along = solution.covariance @ by_camera
    variance = float(by_camera @ along)
    percent = 100 * float(along[0]) / variance / solution.camera.fx
    known = float(np.hypot(sigma, own_sigma))
    scale = 1 / inverse_scale
    return Witness(
        None, None, scale, sigma * scale**2, percent * (1 - inverse_scale), abs(percent) * known,
        bool(abs(1 - inverse_scale) <= CONTRADICTED * np.hypot(known, np.sqrt(variance))))


def clock_of_poses(solution: Solution, poses: Poses, config: Config) -> Witness | None:
    """Return how late the stamps of poses are, by their rotations; None where they do not tell."""
    if poses.stamps_s is None:
        return None
    start_s = float(poses.stamps_s[0])
    loss_px = loss_px_of(solution.scenes, solution.camera, config.intrinsics)
    turns = [steps_of(scene, solution, loss_px, start_s) for scene in solution.scenes
             if scene.turn.of_this_drive and len(scene.observed.keyframes) >= LEAST_KEYFRAMES]
    rate = _rate_of(poses.stamps_s - start_s, poses.rotations, turns)
    fit = None if len(rate.stamps_s) < LEAST_KEYFRAMES else fit_to(turns, rate)
    if (fit is None or fit.out_of_pace or not fit.explained >= LEAST_EXPLAINED
            or abs(fit.gyro.offset_s) >= LARGEST_OFFSET_S):
        return None
    sigmas = np.sqrt(np.diag(fit.covariance))
    return clock(fit.gyro.offset_s, float(np.hypot(sigmas[7], MADE_S)), fit.gyro.pace,
                 float(sigmas[8]))


# s between the samples of a rate that is made of poses
POSES_S = 0.01


def _rate_of(stamps_s: Floats, rotations: Floats, turns: Sequence[Steps]) -> Samples:
    """Return how fast what has these rotations (n, 3, 3) to the world turned, about its own axes.

    Only about the time of the turns: poses may be years apart.
    """
    from scipy.interpolate import CubicSpline
    angles = np.cumsum(np.pad(_turned(rotations.transpose(0, 2, 1)), ((1, 0), (0, 0))), axis=0)
    when = np.unique(np.concatenate([np.zeros(0), *(np.arange(
        turn.stamps_s[0] - LARGEST_OFFSET_S, turn.stamps_s[-1] + LARGEST_OFFSET_S, POSES_S)
        for turn in turns)]))
    when = when[(when >= stamps_s[0]) & (when < stamps_s[-1])]
    after = np.searchsorted(stamps_s, when, side='right')
    when = when[np.diff(stamps_s)[after - 1] <= LONGEST_GAP_S]
    return Samples(when, CubicSpline(stamps_s, angles)(when, 1))


@dataclass(frozen=True)
class Steps:
    """How a camera turned from keyframe to keyframe.

    stamps_s: (k,); turned: (k - 1, 3) rad, in the camera's axes; follow: (k - 1, 3, n) its
    derivatives by the camera's parameters.
    """

    stamps_s: Floats
    turned: Floats
    follow: Floats


@dataclass(frozen=True)
class Gyro:
    """A gyro beside a camera. alignment, bias, inverse_scale: as in the module's description.

    offset_s: how late its stamps are at middle_s; pace: by how much more a second later.
    """

    alignment: Floats
    bias: Floats
    inverse_scale: float
    offset_s: float
    middle_s: float
    pace: float = 0.0

    def when(self, stamps_s: Floats) -> Floats:
        """Return the gyro's stamps of what happened at those of the pictures."""
        return stamps_s + self.offset_s + self.pace * (stamps_s - self.middle_s)

    def moved(self, step: Floats) -> Gyro:
        """Return the gyro a step (9,) away; their order is that of Fit's covariance."""
        from scipy.spatial.transform import Rotation
        offset = np.clip(self.offset_s + step[7], -2 * LARGEST_OFFSET_S, 2 * LARGEST_OFFSET_S)
        turned = Rotation.from_rotvec(step[:3]).as_matrix()
        return Gyro(turned @ self.alignment, self.bias + step[3:6],
                    float(self.inverse_scale + step[6]), float(offset), self.middle_s,
                    float(self.pace + step[8]))


# sigmas of the prior of the pace beyond which a clock is not used
LARGEST_PACE = 2.0
# s, and sigmas; turns whose own offsets are farther apart have clocks that do not keep pace
LARGEST_SKEW_S, SKEW_SIGMAS = 0.02, 5.0
# times what a turn's other steps leave; where an image is missing in a turn of 50 degrees or more
# one step left 4.7 to 14 times that, and else at most 4.2
LARGEST_JUMP = 4.5
# a stretch that turns less shows no missing image, but a bump
JUMPING_DEG = 30.0


@dataclass(frozen=True)
class Fit:
    """How a gyro and a camera fit together.

    covariance: (9, 9) of the small rotation (3), bias (3), 1 / scale, offset and pace. by_camera:
    (n,) by how much 1 / scale follows the camera's parameters. explained: of the squared angles.
    skew_s: between the turns' own offsets, where that is not by chance; else 0. jump: what a step
    leaves, over the RMS of the others of its turn.
    """

    gyro: Gyro
    covariance: Floats
    by_camera: Floats
    explained: float
    skew_s: float
    jump: float

    @property
    def scale(self) -> float:
        """Return the sensor's angles over the camera's."""
        return 1 / self.gyro.inverse_scale

    @property
    def out_of_pace(self) -> str:
        """Return in words how the clocks are out of pace; '' where they are not."""
        if self.skew_s > LARGEST_SKEW_S:
            return f'turns are {1e3 * self.skew_s:.0f} ms apart'
        if self.jump > LARGEST_JUMP:
            return 'they jump within a turn'
        if abs(self.gyro.pace) > LARGEST_PACE * PACE:
            return f'they differ by {100 * self.gyro.pace:+.1f} % of time'
        return ''

    def scaled(self, own: float) -> Fit:
        """Return the same for a gyro whose angles are known to be own times the true ones."""
        return replace(self, gyro=replace(
            self.gyro, inverse_scale=self.gyro.inverse_scale * own))


def steps_of(scene: Scene, solution: Solution, loss_px: float, start_s: float) -> Steps:
    """Return how a scene's camera turned. start_s: stamp of the drive's first image."""
    structure, rows = scene.structure, scene.observed.keyframes
    normal = normal_equations(
        State(lens_alone(solution.camera), (scene,)).linear(loss_px)[0])
    follow = []
    for step in np.diag(np.sqrt(np.diag(solution.covariance))):
        sigma = float(step.max())
        ahead, behind = (normal.moved(sign * step).structure.rotations[rows] for sign in (1, -1))
        follow.append((_turned(ahead) - _turned(behind)) / (2 * sigma))
    start_ns = round(start_s * 1e9)
    stamps_s = (scene.tracks.stamps_ns[rows] - start_ns) / 1e9
    return Steps(stamps_s, _turned(structure.rotations[rows]), np.stack(follow, axis=-1))


def _turned(rotations: Floats) -> Floats:
    """Return (k - 1, 3) rad, from one rotation (k, 3, 3), world to camera, to the next."""
    from scipy.spatial.transform import Rotation
    return np.asarray(Rotation.from_matrix(
        rotations[:-1] @ rotations[1:].transpose(0, 2, 1)).as_rotvec())


# s over which a rate is taken, to know how an angle follows the offset
RATE_S = 0.03


def _covered(turn: Steps, stamps_s: Floats, when: Floats) -> Steps | None:
    """Return the part of a turn for which there are samples; None where it is too short.

    stamps_s: (n,) of the sensor; when: of the keyframes, on its clock.
    """
    gaps = np.flatnonzero(np.diff(stamps_s) > LONGEST_GAP_S)
    piece = np.searchsorted(stamps_s[gaps + 1], when, side='right')
    begins = np.r_[stamps_s[0], stamps_s[gaps + 1]][piece]
    ends = np.r_[stamps_s[gaps], stamps_s[-1]][piece]
    inside = (when > begins + 2 * RATE_S) & (when < ends - 2 * RATE_S)
    best = max((np.flatnonzero(inside & (piece == each)) for each in np.unique(piece)), key=len)
    if len(best) < LEAST_KEYFRAMES:
        return None
    first, last = int(best[0]), int(best[-1])
    return Steps(turn.stamps_s[first:last + 1], turn.turned[first:last], turn.follow[first:last])


def fit_to(turns: Sequence[Steps], rate: Samples) -> Fit | None:
    """Return how a gyro fits to the turns, those parts of them for which it has samples."""
    angles, found = rate.integral, None
    for _ in range(2):
        covered = [part for turn in turns if (part := _covered(
            turn, rate.stamps_s,
            turn.stamps_s if found is None else found.gyro.when(turn.stamps_s))) is not None]
        found = _fit_gyro(covered, angles)
        if found is None or not abs(found.gyro.offset_s) < LARGEST_OFFSET_S:
            break
    return found


# s between the offsets that are tried first; a turn takes seconds
COARSE_S = 0.02
# degrees in all turns; with less there is no angle to compare
LEAST_TURNED_DEG = 10.0
# parameters of a gyro beside a camera
UNKNOWNS = 9
# steps of the fit, and those at which the noises are weighed anew
STEPS, WEIGHED = 8, (1, 4)


def _fit_gyro(turns: Sequence[Steps], angles: Samples) -> Fit | None:
    """Return how a gyro fits to the turns; None where too little was turned.

    angles: (n, 3) rad, the gyro's rates added up.
    """
    total = np.degrees(sum(np.linalg.norm(turn.turned.sum(axis=0)) for turn in turns))
    if not turns or total < LEAST_TURNED_DEG:
        return None
    start = min((_aligned(turns, angles, offset) for offset in
                 np.arange(-LARGEST_OFFSET_S, LARGEST_OFFSET_S + COARSE_S / 2, COARSE_S)),
                key=lambda each: each[0])
    gyro = Gyro(*start[1:], middle_s=float(np.mean(np.concatenate(
        [turn.stamps_s for turn in turns]))))
    ratio = 1.0
    for number in range(STEPS):
        rows = [_linear(turn, angles, gyro) for turn in turns]
        if number in WEIGHED:
            ratio = _likeliest_ratio(turns, rows)
        jacobian, residual, _ = _whitened(turns, rows, ratio)
        noise = float(residual @ residual) / max(len(residual) - UNKNOWNS, 1)
        # the pace has a prior, one more measurement
        weight = np.sqrt(noise) / PACE
        gyro = gyro.moved(np.linalg.lstsq(
            np.vstack([jacobian, weight * np.eye(UNKNOWNS)[-1]]),
            np.r_[residual, -weight * gyro.pace], rcond=None)[0])
    rows = [_linear(turn, angles, gyro) for turn in turns]
    jacobian, residual, follow = _whitened(turns, rows, ratio)
    noise = float(residual @ residual) / max(len(residual) - UNKNOWNS, 1)
    hessian = jacobian.T @ jacobian
    hessian[-1, -1] += noise / PACE**2
    covariance = np.asarray(noise * np.linalg.inv(hessian), np.float64)
    # which of the clocks is wrong is not known, nor whether it jumped: an angle may be off by that
    covariance[6, 6] += (gyro.pace * gyro.inverse_scale)**2
    parts, rests = _by_turn(turns, jacobian), _by_turn(turns, residual)
    # what each turn alone would change of the scale and of the offset, all else as it is
    variances = np.array([noise / np.sum(part[:, 6:8]**2, axis=0) for part in parts])
    own = np.array([part[:, 6:8].T @ rest / np.sum(part[:, 6:8]**2, axis=0)
                    for part, rest in zip(parts, rests, strict=True)])
    covariance[6, 6] += _between_turns(own[:, 0], variances[:, 0], gyro.inverse_scale)
    clear = np.abs(own[:, 1]) > SKEW_SIGMAS * np.sqrt(variances[:, 1])
    turned = np.concatenate([turn.turned for turn in turns])
    lefts = [np.linalg.norm(row[1], axis=1) for row in rows]
    left = np.concatenate(lefts)
    return Fit(gyro, covariance, np.linalg.solve(hessian, jacobian.T @ follow)[6],
               1 - float(np.sum(left**2) / np.sum(turned**2)),
               float(np.max(np.abs(own[:, 1]), where=clear, initial=0.0)),
               max((_largest(each) for turn, each in zip(turns, lefts, strict=True)
                    if np.degrees(np.linalg.norm(turn.turned.sum(axis=0))) > JUMPING_DEG),
                   default=0.0))


def _largest(left: Floats) -> float:
    """Return the largest of what a turn's steps (k,) leave over the RMS of the others."""
    largest = float(left.max())
    return largest / float(np.sqrt((np.sum(left**2) - largest**2) / (len(left) - 1)))


# of a turn's angle: what pictures of real drives may be off in one turn, beyond their noise
TURN_SIGMA = 0.0045


def _between_turns(offsets: Floats, variances: Floats, size: float) -> float:
    """Return the variance of a common value that turns which differ by TURN_SIGMA add to it.

    offsets, variances: (t,) of each turn's own value, which is of this size.
    """
    more = (TURN_SIGMA * size)**2
    if len(offsets) == 1:
        return more
    whole = variance_if_turns_differ(offsets, variances, more)
    return float(max(whole - 1 / np.sum(1 / variances), 0.0))


# of likelihoods; beyond it the less likely case counts for nothing
LARGEST_LOG = 100.0


def variance_if_turns_differ(offsets: Floats, variances: Floats, more: float) -> float:
    """Return the variance of a common value where each turn may be off by a variance more.

    offsets, variances: (t,) of what each of at least two turns says alone. Either turns differ as
    their noise says, or by that more: both are as likely before, and are weighed by how well they
    explain the turns. Where they differ by more than a case says, its variance grows with that.
    """
    logs, found = [], []
    for extra in (0.0, more):
        mean = weighted_mean(offsets, variances + extra)
        logs.append(0.5 * float(np.log(mean.variance) - np.log(variances + extra).sum()
                                - mean.squares))
        found.append(mean.widened + mean.value**2)
    share = 1 / (1 + np.exp(min(logs[0] - logs[1], LARGEST_LOG)))
    return float((1 - share) * found[0] + share * found[1])


def _aligned(turns: Sequence[Steps], angles: Samples, offset: float
             ) -> tuple[float, Floats, Floats, float, float]:
    """Return what is left, and for an offset a start: rotation, no bias, 1 / scale, offset."""
    sensor = np.concatenate([_between(angles, turn.stamps_s + offset) for turn in turns])
    camera = np.concatenate([turn.turned for turn in turns])
    u, sizes, v = np.linalg.svd(camera.T @ sensor)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation = u @ sign @ v
    gain = float(sizes @ np.diag(sign)) / max(float(np.sum(sensor**2)), 1e-12)
    left = float(np.sum((camera - gain * sensor @ rotation.T)**2))
    return left, rotation, np.zeros(3), gain, float(offset)


def _between(angles: Samples, stamps_s: Floats) -> Floats:
    """Return (k - 1, 3) what was turned between stamps (k,)."""
    return np.diff(angles.at(stamps_s), axis=0)


def _linear(turn: Steps, angles: Samples, gyro: Gyro) -> tuple[Floats, Floats]:
    """Return (k - 1, 3, 9) derivatives of the prediction, and (k - 1, 3) what it leaves."""
    when, apart = gyro.when(turn.stamps_s), np.diff(turn.stamps_s)[:, None]
    plain = (_between(angles, when) - gyro.bias * apart) @ gyro.alignment.T
    predicted = gyro.inverse_scale * plain
    rate = gyro.inverse_scale * (angles.at(when + RATE_S) - angles.at(when - RATE_S)
                                 ) @ gyro.alignment.T / (2 * RATE_S)
    jacobian = np.zeros((len(plain), 3, UNKNOWNS))
    # a small rotation w of the alignment moves the prediction p by w x p
    for axis, unit in enumerate(np.eye(3)):
        jacobian[:, :, axis] = np.cross(unit, predicted)
    jacobian[:, :, 3:6] = -gyro.inverse_scale * apart[:, :, None] * gyro.alignment
    jacobian[:, :, 6] = plain
    jacobian[:, :, 7] = np.diff(rate, axis=0)
    jacobian[:, :, 8] = np.diff(rate * (turn.stamps_s - gyro.middle_s)[:, None], axis=0)
    return jacobian, turn.turned - predicted


def _whitening(turn: Steps, ratio: float) -> tuple[Floats, float]:
    """Return what makes the noise of a turn's steps white, (k - 1, k - 1), and its log size.

    ratio: of the variance of a keyframe's pose to that of the gyro in a second.
    """
    root = np.linalg.cholesky(of_steps(np.diff(turn.stamps_s), ratio))
    return np.linalg.inv(root), float(np.log(np.diag(root)).sum())


Rows = Sequence[tuple[Floats, Floats]]


def _whitened(turns: Sequence[Steps], rows: Rows, ratio: float) -> tuple[Floats, Floats, Floats]:
    """Return derivatives (m, 9), residuals (m,), and what the camera does to them (m, n)."""
    parts = []
    for turn, (jacobian, residual) in zip(turns, rows, strict=True):
        white = _whitening(turn, ratio)[0]
        parts.append((np.einsum('ij,jac->iac', white, jacobian).reshape(-1, UNKNOWNS),
                      (white @ residual).reshape(-1),
                      np.einsum('ij,jac->iac', white, turn.follow).reshape(
                          -1, turn.follow.shape[2])))
    jacobian, residual, follow = (np.concatenate(each) for each in zip(*parts, strict=True))
    return jacobian, residual, follow


def _by_turn(turns: Sequence[Steps], rows: Floats) -> list[Floats]:
    return np.split(rows, np.cumsum([3 * len(turn.turned) for turn in turns])[:-1])


# ratios of the poses' variance to the gyro's in a second, of which the likeliest is taken
RATIOS = np.logspace(-4, 3, 22)


def _likeliest_ratio(turns: Sequence[Steps], rows: Rows) -> float:
    """Return the ratio of the two noises that explains the residuals best."""
    def badness(ratio: float) -> float:
        jacobian, residual, _ = _whitened(turns, rows, ratio)
        step = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
        squares = float(np.sum((residual - jacobian @ step)**2))
        logs = sum(_whitening(turn, ratio)[1] for turn in turns)
        return len(residual) / 2 * float(np.log(max(squares, 1e-300))) + 3 * logs
    return float(min(RATIOS, key=badness))


@dataclass(frozen=True)
class _End:
    """A straight before or after a turn.

    yaw: rad, the camera's there; follow: (n,) what that does with the camera's parameters. slip:
    rad by which an aerial that is not over the rear axle goes beside the car's heading, and by
    which the fixes turn there: where they are late, or filtered, a straight ends in the turn.
    """

    straight: Straight
    yaw: float
    follow: Floats
    slip: float

    @property
    def off_m(self) -> float:
        return float(np.sqrt(np.mean(self.straight.left**2)))


# minimum angle of a turn between two headings of GPS, degrees
LEAST_GPS_DEG = 30.0


def _gps(turns: Sequence[Steps], position: Samples, solution: Solution, apart: str,
         doubt_s: float) -> tuple[Witness | None, Notice | None]:
    """Return what GPS headings say, from straight to straight, or why they say nothing.

    apart: as _apart() has it; doubt_s: by how much its clock may be off.
    """
    if apart:
        return None, Notice('E-GPS-NO-SAMPLES', f'GPS is not compared with the turns: it has no '
                            f'fixes during them, {apart}')
    if doubt_s:
        return None, Notice(
            'E-GPS-CLOCK', 'GPS is not compared with the turns: its clock is not known to be that '
            'of the images, within a fraction of a second: use images with time stamps')
    pairs = [pair for turn in turns if (pair := _ends(turn, position)) is not None]
    if not pairs:
        return None, Notice(
            'E-GPS-NO-STRAIGHTS', f'GPS is not compared with the turns: in the images of no turn '
            f'are {FIXES} fixes on {STRAIGHT_M:g} m of straight road both before and after it: '
            f'use a receiver with more fixes per second, and turns between straights')
    blurred = Notice(
        'E-GPS-HEADINGS', f'GPS is not compared with the turns: no turn of {LEAST_GPS_DEG:g} '
        f'degrees or more has headings that are known to {HEADING_SIGMA_DEG:g} degrees: drive '
        f'turns with longer straights, under open sky')
    usual = float(np.median([each.off_m for pair in pairs for each in pair]))
    sound = [pair for pair in pairs
             if all(each.off_m <= max(JUMP * usual, LEAST_NOISE_M) for each in pair)]
    if not sound:
        return None, blurred
    straights = [each.straight for pair in sound for each in pair]
    noise_m = max(float(np.sqrt(sum(each.off_m2 for each in straights)
                                / sum(each.freedom for each in straights))), LEAST_NOISE_M)
    measured, ours, sigmas, follow = [], [], [], []
    for before, after in sound:
        sigma = float(np.sqrt(
            noise_m**2 * (1 / before.straight.spread_m2 + 1 / after.straight.spread_m2)
            + before.slip**2 + after.slip**2))
        ours_rad = after.yaw - before.yaw
        if np.degrees(sigma) > HEADING_SIGMA_DEG or abs(ours_rad) < np.radians(LEAST_GPS_DEG):
            continue
        # of all angles that headings allow, the nearest: turns are less than 180 degrees off
        turned = after.straight.heading - before.straight.heading
        ours.append(ours_rad)
        measured.append(ours_rad + float(np.angle(np.exp(1j * (turned - ours_rad)))))
        sigmas.append(sigma)
        follow.append(after.follow - before.follow)
    if not ours:
        return None, blurred
    camera, gps = np.array(ours), np.array(measured)
    ratios, variances = camera / gps, (np.array(sigmas) / gps)**2
    mean = weighted_mean(ratios, variances)
    if not 1 / SCALES[1] < mean.value < 1 / SCALES[0]:
        return None, Notice(
            'E-GPS-OTHER-MOTION', 'GPS is not used: it does not turn as the pictures do: check '
            'its time stamps, and that it belongs to this drive')
    variance = mean.variance + _between_turns(ratios - mean.value, variances, mean.value)
    by_camera = np.average(np.array(follow) / gps[:, None], axis=0, weights=1 / variances)
    return _witness(mean.value, float(np.sqrt(variance)), 0.0, by_camera, solution), None


# degrees by which the car may turn on what counts as a straight
STRAIGHT_DEG = 1.5
# m from the rear axle, which goes where the car points, to the aerial
LEVER_M = 2.0
# minimum length of a straight, m
STRAIGHT_M = 8.0


def _ends(turn: Steps, position: Samples) -> tuple[_End, _End] | None:
    """Return the straights before and after a turn; None where one has too few fixes."""
    # a car turns about the vertical: y points down, and a turn to the left is negative about it
    axis = main_axis(np.cumsum(turn.turned, axis=0))
    yaw = -np.r_[0.0, np.cumsum(turn.turned @ axis)]
    follow = -np.concatenate([np.zeros((1, turn.follow.shape[2])),
                              np.cumsum(np.einsum('kan,a->kn', turn.follow, axis), axis=0)])
    limit, found = np.radians(STRAIGHT_DEG), []
    last = len(yaw) - 1
    begin = int(np.argmax(np.abs(yaw - yaw[0]) > limit)) - 1
    end = last - int(np.argmax(np.abs(yaw[::-1] - yaw[-1]) > limit)) + 1
    for first, past in ((0, begin), (end, last)):
        straight = None if past <= first else straight_between(
            turn.stamps_s[first], turn.stamps_s[past], position, STRAIGHT_M)
        if straight is None:
            return None
        when, along = straight.stamps_s, straight.along
        found.append(_End(
            straight, float(np.interp(when, turn.stamps_s, yaw).mean()),
            np.array([np.interp(when, turn.stamps_s, column).mean() for column in follow.T]),
            float(np.hypot(np.ptp(yaw[first:past + 1]) * LEVER_M / np.ptp(along),
                           2 * np.polyfit(along, straight.left, 2)[0] * np.ptp(along)))))
    return found[0], found[1]
