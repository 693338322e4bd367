# SPDX-License-Identifier: Apache-2.0
"""Watches a camera in use, turn by turn: has it been zoomed, cropped, exchanged or moved since.

A single turn may be wrong, by traffic, lost images or a bad reconstruction. So a change is
suspected after one turn, and reported when a second one confirms it. It is taken back only when
two turns since then speak against it: no state flickers, and none outlives its reason. The newest
turns are compared with those before them, not with the calibration alone: where that one is off
in all turns alike, nothing has changed.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config, MonitorConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.judge.agreement import MAX_MISFIT
from dashcalib_ros.judge.difference import CONTRADICTION, LEAST_SIGMA, RELEVANT, Way, limit_of
from dashcalib_ros.problem.blocks import lens_alone
from dashcalib_ros.problem.normal import normal_equations
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.problem.steps import State
from dashcalib_ros.reconstruct.heading import Heading, heading
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.optimise import loss_px_of

Kind = Literal['lens', 'mount']


@dataclass(frozen=True)
class Reading:
    """One turn, explained with a fixed camera.

    cost: about the camera's n parameters, at unit noise, each track one measurement. heading: of
    the camera in the car; None where the turn does not show it. misfit: the turn's cost with this
    camera over that with its own. explained: False where it is so large that no quadratic function
    says by how much the camera is off; cost is 0 then.
    """

    turn: TurnId
    cost: Quadratic
    heading: Heading | None
    explained: bool = True
    misfit: float = 1.0

    def gain(self, offsets: Floats) -> float:
        """Return by how much the turn prefers a camera with other parameters, (n,) offsets.

        It is twice the logarithm of a ratio of likelihoods, positive where the other one is
        likelier.
        """
        return -self.cost.change(offsets)


def reading_of(scene: Scene, camera: Camera, config: Config) -> Reading:
    """Explain a turn with a fixed camera, poses and points adjusted anew; loads COLMAP.

    scene: as its turn was reconstructed. camera: of the scene's pictures.
    """
    from dashcalib_ros.solve.start import misfits, scene_with
    count = len(camera.names())
    found = scene_with(camera, scene, config)
    misfit = np.inf if found is None else misfits(
        [scene], [found], camera, config.scene.error_px)[scene.turn]
    if found is None or misfit > MAX_MISFIT:
        nothing = Quadratic.prior(np.zeros((count, count)))
        return Reading(scene.turn, nothing, None, False, misfit)
    loss_px = loss_px_of([found], camera, config.intrinsics)
    alone = State(lens_alone(camera), (found,))
    variance = alone.noise(loss_px).variance
    cost = normal_equations(alone.linear(loss_px)[0], tracks=True).cost.at_noise(variance)
    # errors that the observations of a track share make it worth less than their number
    inflation = max(1.0, float(np.trace(np.linalg.pinv(cost.hessian) @ cost.by_track)) / count)
    return Reading(scene.turn, cost.at_noise(inflation), heading(found), misfit=misfit)


def readings_of(scenes: Iterable[Scene], camera: Camera, config: Config) -> tuple[Reading, ...]:
    """Return how each turn fits a camera in use; camera: of the scenes' pictures."""
    return tuple(reading_of(scene, camera, config) for scene in scenes)


@dataclass(frozen=True)
class Change:
    """A change, and the first turn that shows it.

    lens: focal lengths or centre differ, or another camera took the pictures: the calibration is
    wrong. mount: the camera points elsewhere in the car; the calibration stays right.
    zoom: by how much fx has grown, of fx; shift: (2,) of the centre, of the picture's width: what
    explains the turns best if nothing else has changed; both NaN where the camera in use explains
    the turns so badly that they are not known. looks_like: in words, what explains the turns as
    well as any other camera does; each of the texts does so alone, () where none does.
    turned_deg: (2,) the yaw and pitch of the mounting. turns: how many show it; one is a
    suspicion.
    """

    kind: Kind
    since: TurnId
    turns: int
    zoom: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    looks_like: tuple[str, ...] = ()
    turned_deg: tuple[float, float] = (0.0, 0.0)

    @property
    def confirmed(self) -> bool:
        """Return whether two turns or more show it."""
        return self.turns > 1

    def __str__(self) -> str:
        since = f'since {self.since}'
        if self.kind == 'mount':
            return moved_text(since, self.turned_deg)
        if not self.looks_like:
            return (f'the calibration does not explain the pictures {since}: check whether it is '
                    f'another camera, or another part of its picture')
        return (f'the calibration does not fit {since}, as if {", or ".join(self.looks_like)}; '
                f'check whether the camera was zoomed, refocused or exchanged, or its picture '
                f'cropped')


def moved_text(than: str, turned_deg: Sequence[float] | Floats) -> str:
    """Return that a camera points elsewhere, with (2,) degrees to the left and upwards."""
    yaw, pitch = turned_deg
    return (f'the camera points elsewhere {than}: by {abs(yaw):.1f} degrees to the '
            f'{"left" if yaw > 0 else "right"} and {abs(pitch):.1f} '
            f'{"up" if pitch > 0 else "down"}; its calibration stays right')


# times the least sigmas: the error of an unknown camera
UNKNOWN = 100.0
# times the zoom that is found, between which the true one is: the linear step overshoots by half
# and more, and noise adds to it
TRUE_ZOOM = (0.4, 1.3)
# a zoom that the camera in use explains no longer; of made turns it mostly explains 5 %, not 8 %
UNEXPLAINED_ZOOM = 0.05
# of the evidence; parts of the camera that leave less are the explanation: a turn's cost is not
# exactly quadratic, so that the others gain some evidence from a change they have no part in
UNEXPLAINED = 0.2
# by which the turns of one camera vary more than their noise; KITTI 03: up to 5
SCATTER = 3.0
# of fx, or of the width: smaller changes are not reported
LEAST_CHANGE = 0.008
# degrees; a camera that was moved by less is not reported
LEAST_TURNED_DEG = 0.6
# degrees; the direction of travel varies so much between turns, sideways
HEADING_SIGMA_DEG = 0.15
# degrees; the same up and down: roads, brakes and load
PITCH_SIGMA_DEG = 0.2
# degrees; a turn that shows the direction of travel worse is not used
MAX_HEADING_SIGMA_DEG = 1.0


@dataclass(frozen=True)
class Monitor:
    """The state after some turns; after() returns the next one.

    camera, covariance: (n, n) of the calibration in use. proven: whether it is known to have
    fitted turns before these. Then a misfit from the first turn on is a change, too; otherwise it
    may never have fitted, and only turns behind one that it explains can show that it changed.
    readings: the newest ones, the oldest first. lens, mount: the present change, None where there
    is none.
    """

    camera: Camera
    covariance: Floats
    config: MonitorConfig
    proven: bool
    readings: tuple[Reading, ...] = ()
    lens: Change | None = None
    mount: Change | None = None

    @property
    def changes(self) -> tuple[Change, ...]:
        """Return the changes that two turns or more show."""
        return tuple(each for each in (self.lens, self.mount)
                     if each is not None and each.confirmed)

    @property
    def agrees(self) -> bool:
        """Return whether turns of this drive confirm the camera in use.

        It explains them, and together they exclude a RELEVANT zoom by three sigmas.
        """
        own = [each for each in self.readings if each.turn.of_this_drive]
        if not own or self.lens is not None or not self._explains(own):
            return False
        zoom = RELEVANT * self._zoom_and_shift()[:, 0]
        against = min(-sum(each.gain(size) for each in own) for size in (zoom, -zoom))
        return against / SCATTER > CONTRADICTION**2

    def after(self, reading: Reading) -> Monitor:
        """Return the state after one more turn."""
        readings = (*self.readings, reading)[-self.config.turns:]
        following = replace(self, readings=readings)
        return replace(following, lens=following._lens(), mount=following._mount())

    def _lens(self) -> Change | None:
        found = self._lens_change()
        if self.lens is None or not self.lens.confirmed:
            return found
        if found is not None and found.confirmed:
            # the turns that showed it first may be older than the newest ones
            return replace(found, since=min(found.since, self.lens.since))
        # it was there: only turns that speak against it take it back
        against = [self._against(each, self.lens) > self.config.limit
                   for each in self.readings if each.turn > self.lens.since]
        return None if sum(against) > 1 else self.lens

    def _lens_change(self) -> Change | None:
        found: Change | None = None
        basis = self._zoom_and_shift()
        for first in reversed(range(len(self.readings))):
            before, newest = self.readings[:first], self.readings[first:]
            size, evidence = self._fitted(before, newest, basis, self.proven)
            unlike = [self._unlike(each) for each in newest]
            shows = [bad or each.gain(basis @ size) > self.config.turn_limit
                     for each, bad in zip(newest, unlike, strict=True)]
            if not (shows[0] and shows[-1]):
                continue
            if evidence > self.config.limit and np.abs(size).max() > LEAST_CHANGE:
                zoom, *shift = map(float, size)
                change = Change('lens', newest[0].turn, sum(shows), zoom, (shift[0], shift[1]),
                                self._looks_like(before, newest))
            elif unlike[0] and unlike[-1]:
                change = Change('lens', newest[0].turn, sum(unlike), np.nan, (np.nan, np.nan))
                # turns that knew it would not be explained
                if any(self._against(each, change) > self.config.limit for each in newest):
                    continue
            else:
                continue
            if self.proven or self._fitted_before(before, change):
                found = change
        return found

    def _unlike(self, reading: Reading) -> bool:
        """Return whether a turn is explained clearly worse than by its own camera.

        Lost images make one cost more, too: what is explained must ask for another camera.
        """
        if not reading.explained:
            return True
        offsets = np.asarray(np.linalg.pinv(reading.cost.hessian) @ reading.cost.score, np.float64)
        return (reading.misfit > self.config.max_misfit
                and reading.gain(offsets) / SCATTER > self.config.limit)

    def _explains(self, readings: Sequence[Reading]) -> bool:
        _, evidence = self._fitted((), readings, self._zoom_and_shift(), True)
        return not any(map(self._unlike, readings)) and evidence <= self.config.limit

    def _fitted_before(self, before: Sequence[Reading], change: Change) -> bool:
        """Return whether the camera in use explains the turns before a change, and one shows it.

        Turns that know little of the lens are explained by any camera: at least one must speak
        against the change as clearly as the turns behind it must speak for it.
        """
        against = [self._against(each, change) / SCATTER for each in before]
        return max(against, default=0.0) > self.config.limit and self._explains(before)

    def _against(self, reading: Reading, change: Change) -> float:
        """Return by how much a turn that the camera in use explains prefers it to a changed one.

        A change without a size is taken for a zoom either way.
        """
        if not self._explains([reading]):
            return 0.0
        basis = self._zoom_and_shift()
        changes = ([(change.zoom, *change.shift)] if np.isfinite(change.zoom)
                   else [(UNEXPLAINED_ZOOM, 0.0, 0.0), (-UNEXPLAINED_ZOOM, 0.0, 0.0)])
        return min(-reading.gain(basis @ sizes) for sizes in changes)

    def _fitted(self, before: Sequence[Reading], newest: Sequence[Reading], basis: Floats,
                trusted: bool) -> tuple[Floats, float]:
        """Return the change between turns that explains them best, and the evidence for it.

        basis: (n, m) by how much each of m changes moves the n parameters; the sizes (m,) are of
        these. The calibration in use is itself uncertain, and the turns before the change say
        where it is off: evidence that an error in all turns alike explains does not count.
        trusted: whether such an error is as small as the covariance says. The evidence is that of
        a chi-squared with m degrees of freedom.
        """
        newer = self._together(newest)
        covariance = self.covariance if trusted else UNKNOWN**2 * self.covariance
        known = Quadratic.prior(np.asarray(np.linalg.inv(covariance)))
        others = Quadratic.together([self._together(before), known])
        # the share of the newest turns in what all turns together say about an error alike in all
        share = newer.hessian @ np.linalg.inv(newer.hessian + others.hessian)
        information = basis.T @ (newer.hessian - share @ newer.hessian) @ basis
        pull = basis.T @ (newer.score - share @ (newer.score + others.score))
        size = np.asarray(np.linalg.lstsq(information, pull, rcond=None)[0], np.float64)
        return size, float(pull @ size)

    def _together(self, readings: Sequence[Reading]) -> Quadratic:
        """Return the sum of turns' costs, for their true scatter; 0 for no turns."""
        nothing = Quadratic.prior(np.zeros_like(self.covariance))
        return Quadratic.together([nothing, *(each.cost for each in readings)]).at_noise(
            SCATTER)

    def _zoom_and_shift(self) -> Floats:
        """Return (n, 3): a zoom of 1, and shifts of the centre by the picture's width."""
        basis = np.zeros((len(self.camera.params), 3))
        basis[:2, 0] = self.camera.params[:2]
        basis[2, 1] = basis[3, 2] = self.camera.image_size[0]
        return basis

    def _looks_like(self, before: Sequence[Reading], newest: Sequence[Reading]
                    ) -> tuple[str, ...]:
        """Return the fewest parts of the camera that explain the change, in words.

        Several texts where other parts explain it as well. Only the sizes of a change of focal
        length and centre can be named: coefficients of distortion make up for each other.
        """
        count = len(self.camera.params)
        zoom_and_shift, every = self._zoom_and_shift(), np.eye(count)
        ways: dict[Way, Floats] = {
            'focal length': zoom_and_shift[:, :1], 'centre': zoom_and_shift[:, 1:],
            'distortion': every[:, 4:]}
        _, most = self._fitted(before, newest, every, self.proven)
        for parts in range(1, len(ways) + 1):
            texts = []
            for chosen in combinations(ways, parts):
                basis = np.hstack([ways[way] for way in chosen])
                size, evidence = self._fitted(before, newest, basis, self.proven)
                left = limit_of(count - len(size))**2
                if most - evidence <= max(left, UNEXPLAINED * most):
                    texts.append(self._in_words(chosen, basis @ size))
            if texts:
                return tuple(texts)
        return ()

    def _in_words(self, ways: Sequence[Way], offsets: Floats) -> str:
        zoom = 100 * offsets[0] / self.camera.fx
        least, most = (share * abs(zoom) for share in TRUE_ZOOM)
        shift = 100 * np.abs(offsets[2:4]).max() / self.camera.image_size[0]
        texts: dict[Way, str] = {
            'focal length': f'its focal length were {least:.1f} to {most:.1f} % too '
                            f'{"short" if zoom > 0 else "long"}',
            'centre': f'its centre were up to {shift:.1f} % of the width off',
            'distortion': 'its distortion were different'}
        return ' and '.join(texts[way] for way in ways)

    def _mount(self) -> Change | None:
        """Return where the newest turns' heading differs from that of all before, the last one."""
        # a camera that does not fit bends the path
        known = [each for each in self.readings if each.heading is not None
                 and max(each.heading.yaw_sigma_deg, each.heading.pitch_sigma_deg)
                 < MAX_HEADING_SIGMA_DEG and self._explains([each])]
        found: Change | None = None
        clearest = self.config.heading_limit
        # two turns before it, so that one bad turn is not taken for how the camera was mounted
        for count in range(1, len(known) - 1):
            newest = known[-count:]
            (old, old_variance), (new, variance) = (
                self._headings(known[:-count]), self._headings(newest))
            apart = new - old
            sigmas = float(np.max(np.where(np.abs(apart) > LEAST_TURNED_DEG,
                                           np.abs(apart) / np.sqrt(old_variance + variance), 0)))
            if sigmas > clearest:
                clearest = sigmas
                found = Change('mount', newest[0].turn, count,
                               turned_deg=(float(apart[0]), float(apart[1])))
        return found

    def _headings(self, readings: Sequence[Reading]) -> tuple[Floats, Floats]:
        """Return the mean yaw and pitch of readings, (2,), and its variances; degrees."""
        known = [each.heading for each in readings if each.heading is not None]
        angles = np.array([[each.yaw_deg, each.pitch_deg] for each in known])
        own = np.array([[each.yaw_sigma_deg, each.pitch_sigma_deg] for each in known])
        # what turns differ by contains the noise of those that show it well
        weights = np.maximum([HEADING_SIGMA_DEG, PITCH_SIGMA_DEG], own)**-2
        total = weights.sum(axis=0)
        return (weights * angles).sum(axis=0) / total, 1 / total


def watch(readings: Iterable[Reading], camera: Camera, sigma: Mapping[str, float] | None,
          config: MonitorConfig, px: float = 1.0) -> Monitor:
    """Return whether turns show that a camera in use has changed.

    camera: of the readings' pictures. sigma: of its parameters, as far as they are known; None
    for a camera that is not known to have fitted any turns before these: then only turns behind
    one that it explains can show a change. px: of the pictures that sigma is for, in one of the
    readings'.
    """
    known = dict(zip(camera.names(), camera.units(px).tolist(), strict=True))
    monitor = Monitor(camera, _covariance(camera, {
        name: value / known.get(name, 1.0) for name, value in (sigma or {}).items()}), config,
        sigma is not None)
    for reading in sorted(readings, key=lambda reading: reading.turn):
        monitor = monitor.after(reading)
    return monitor


# least sigma of a coefficient of distortion: good calibrations differ by this much
LEAST_DISTORTION_SIGMA = 0.002


def _covariance(camera: Camera, sigma: Mapping[str, float]) -> Floats:
    """Return the (n, n) covariance of a calibration where at most sigmas are known."""
    least = np.full(len(camera.params), LEAST_DISTORTION_SIGMA)
    least[:4] = LEAST_SIGMA * camera.fx
    known = [sigma.get(name, 0.0) for name in camera.names()]
    return np.diag(np.maximum(known, least) ** 2)
