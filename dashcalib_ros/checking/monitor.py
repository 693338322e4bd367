"""Watches a camera in use, turn by turn: has it been zoomed, cropped, exchanged or moved since.

A single turn may be wrong, by traffic or a bad reconstruction. So a change is suspected after one
turn, and told when a second one confirms it. It is taken back only when two turns speak against
it: no state flickers.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.checking.contradiction import LEAST_SIGMA
from dashcalib_ros.checking.reading import Reading
from dashcalib_ros.config import MonitorConfig
from dashcalib_ros.turns.turn import TurnId

Kind = Literal['lens', 'mount']
# least sigma of a coefficient of distortion: good calibrations differ by this much
LEAST_DISTORTION_SIGMA = 0.002


@dataclass(frozen=True)
class Change:
    """A change, and the first turn that shows it.

    lens: focal lengths or centre differ, or another camera took the pictures: the calibration is
    wrong. mount: the camera points elsewhere in the car; the calibration stays right.
    zoom: by how much fx has grown, of fx; shift: (2,) of the centre, of the picture's width; both
    NaN where the camera in use explains the turns so badly that they cannot be told.
    turned_deg: (2,) the yaw and pitch of the mounting. turns: how many show it; one is a
    suspicion.
    """

    kind: Kind
    since: TurnId
    turns: int
    zoom: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    turned_deg: tuple[float, float] = (0.0, 0.0)

    @property
    def confirmed(self) -> bool:
        """Return whether two turns or more show it."""
        return self.turns > 1

    def __str__(self) -> str:
        since = f'since {self.since}'
        if self.kind == 'mount':
            yaw, pitch = self.turned_deg
            return (f'the camera points elsewhere {since}: by {abs(yaw):.1f} degrees to the '
                    f'{"left" if yaw > 0 else "right"} and {abs(pitch):.1f} '
                    f'{"up" if pitch > 0 else "down"}; its calibration stays right')
        if not np.isfinite(self.zoom):
            return (f'the calibration does not explain the pictures {since}: is it another '
                    f'camera, or another part of its picture?')
        return (f'the calibration does not fit {since}: its focal length is about '
                f'{100 * abs(self.zoom):.1f} % too {"short" if self.zoom > 0 else "long"}, its '
                f'centre {100 * max(map(abs, self.shift)):.1f} % of the width off; was the camera '
                f'zoomed or exchanged, or its picture cropped?')


@dataclass(frozen=True)
class Monitor:
    """The state after some turns; after() returns the next one.

    camera, covariance: (n, n) of the calibration in use. readings: the newest ones, the oldest
    first. lens, mount: the present change, None where there is none.
    """

    camera: Camera
    covariance: Floats
    config: MonitorConfig
    readings: tuple[Reading, ...] = ()
    lens: Change | None = None
    mount: Change | None = None

    @property
    def changes(self) -> tuple[Change, ...]:
        """Return the changes that two turns or more show."""
        return tuple(each for each in (self.lens, self.mount)
                     if each is not None and each.confirmed)

    def after(self, reading: Reading) -> Monitor:
        """Return the state after one more turn."""
        readings = (*self.readings, reading)[-self.config.turns:]
        following = replace(self, readings=readings)
        return replace(following, lens=following._lens(), mount=following._mount())

    def _lens(self) -> Change | None:
        found = self._lens_change()
        if found is not None or self.lens is None or not self.lens.confirmed:
            return found
        # it was there: only turns that speak against it take it back
        known = np.isfinite(self.lens.zoom)
        offsets = self._offsets(self.lens)
        against = [each.gain(offsets) < -self.config.limit if known else not self._unlike(each)
                   for each in self.readings[-2:]]
        return None if all(against) else self.lens

    def _lens_change(self) -> Change | None:
        """Return the change of the lens that the newest turns show, None if they do not."""
        found: Change | None = None
        for count in range(1, len(self.readings) + 1):
            newest = self.readings[-count:]
            offsets, evidence = self._fitted([each for each in newest if each.explained])
            unlike = [self._unlike(each) for each in newest]
            shows = [bad or each.gain(offsets) > self.config.turn_limit
                     for each, bad in zip(newest, unlike, strict=True)]
            if not (shows[0] and shows[-1]):
                continue
            change = self._described(offsets, newest[0].turn)
            if (evidence > self.config.limit
                    and max(abs(change.zoom), *np.abs(change.shift)) > self.config.least_change):
                found = replace(change, turns=sum(shows))
            elif unlike[0] and unlike[-1]:
                found = Change('lens', newest[0].turn, sum(unlike), np.nan, (np.nan, np.nan))
        return found

    def _unlike(self, reading: Reading) -> bool:
        """Return whether a turn is explained clearly worse than by its own camera."""
        return not reading.explained or reading.misfit > self.config.max_misfit

    def _fitted(self, readings: Sequence[Reading]) -> tuple[Floats, float]:
        """Return the zoom and shift that explain turns best, as offsets (n,), and the evidence.

        The calibration in use is itself uncertain; evidence that this explains does not count.
        The evidence is that of a chi-squared with three degrees of freedom.
        """
        count = len(self.camera.params)
        hessian = sum((each.hessian for each in readings), np.zeros((count, count)))
        score = sum((each.score for each in readings), np.zeros(count))
        hessian, score = hessian / self.config.scatter, score / self.config.scatter
        known = np.linalg.inv(self.covariance)
        rest = np.eye(len(score)) - hessian @ np.linalg.inv(hessian + known)
        basis = self._basis()
        information = basis.T @ rest @ hessian @ basis
        pull = basis.T @ rest @ score
        size = np.linalg.lstsq(information, pull, rcond=None)[0]
        return np.asarray(basis @ size), float(pull @ size)

    def _basis(self) -> Floats:
        """Return (n, 3): a zoom of 1, and shifts of the centre by the picture's width."""
        basis = np.zeros((len(self.camera.params), 3))
        basis[:2, 0] = self.camera.params[:2]
        basis[2, 1] = basis[3, 2] = self.camera.image_size[0]
        return basis

    def _described(self, offsets: Floats, since: TurnId) -> Change:
        width = self.camera.image_size[0]
        return Change('lens', since, 1, float(offsets[0] / self.camera.fx),
                      (float(offsets[2] / width), float(offsets[3] / width)))

    def _offsets(self, change: Change) -> Floats:
        return np.asarray(np.nan_to_num(self._basis() @ (change.zoom, *change.shift)))

    def _mount(self) -> Change | None:
        """Return where the newest turns' heading differs from that of all before, the last one."""
        known = [each for each in self.readings if each.heading is not None
                 and max(each.heading.yaw_sigma_deg, each.heading.pitch_sigma_deg)
                 < self.config.max_heading_sigma_deg]
        found: Change | None = None
        clearest = self.config.heading_limit
        # two turns before it, so that one bad turn is not taken for how the camera was mounted
        for count in range(1, len(known) - 1):
            newest = known[-count:]
            (old, old_variance), (new, variance) = (
                self._headings(known[:-count]), self._headings(newest))
            apart = new - old
            sigmas = float(np.max(np.where(np.abs(apart) > self.config.least_turned_deg,
                                           np.abs(apart) / np.sqrt(old_variance + variance), 0)))
            if sigmas > clearest:
                clearest = sigmas
                found = Change('mount', newest[0].turn, count,
                               turned_deg=(float(apart[0]), float(apart[1])))
        return found

    def _headings(self, readings: Sequence[Reading]) -> tuple[Floats, Floats]:
        """Return the mean yaw and pitch of the direction of travel (2,), and its variance."""
        angles = np.array([[each.heading.yaw_deg, each.heading.pitch_deg] for each in readings
                           if each.heading is not None])
        varies = np.array([self.config.heading_sigma_deg, self.config.pitch_sigma_deg])
        return angles.mean(axis=0), np.square(varies) / len(angles)


def watch(readings: Iterable[Reading], camera: Camera, sigma: Mapping[str, float],
          config: MonitorConfig) -> Monitor:
    """Return the state after turns, in the order of time.

    camera: of the readings' pictures; sigma: of its parameters, as far as they are known.
    """
    monitor = Monitor(camera, _covariance(camera, sigma), config)
    for reading in readings:
        monitor = monitor.after(reading)
    return monitor


def _covariance(camera: Camera, sigma: Mapping[str, float]) -> Floats:
    """Return the (n, n) covariance of a calibration of which at most sigmas are known."""
    least = np.full(len(camera.params), LEAST_DISTORTION_SIGMA)
    least[:4] = LEAST_SIGMA * camera.fx
    known = [sigma.get(name, 0.0) for name in camera.names()]
    return np.diag(np.maximum(known, least) ** 2)
