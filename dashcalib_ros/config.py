"""The one home of every default, each with the reason for its value.

Users set some twenty of them, setting(); the others are for experts, expert(). What was measured
for a value stands in docs/notebook/lessons.md.

A setting's full name is SECTION.NAME ('turns.half_width'): the same in --set, in a configuration
YAML and as a ROS parameter. Values are checked when a Config is made: one that exists is valid.
"""
from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from dashcalib_ros.errors import ConfigError

T = TypeVar('T')


def setting(default: T, reason: str, minimum: float | None = None, maximum: float | None = None,
            choices: tuple[str, ...] = (), pattern: str = '', *, expert: bool = False) -> T:
    """Declare a setting: its default, why it has that value in one line, and what else it may be.

    expert: few users set it; such settings are listed after the others. What was measured
    for a value stands in docs/notebook/lessons.md under the setting's name.
    """
    metadata = {'reason': reason, 'minimum': minimum, 'maximum': maximum, 'choices': choices,
                'pattern': pattern, 'expert': expert}
    value: T = field(default=default, metadata=metadata)
    return value


# declares a setting for experts
expert = functools.partial(setting, expert=True)


@dataclass(frozen=True)
class MotionConfig:
    """frames -> tracks -> epipoles, for detection only (calibration tracks again, finer)."""

    rate: float = setting(
        10.0, 'Hz; faster cameras are thinned to it: the paper works at 10 fps', 1.0, 60.0)
    width: int = expert(
        640, 'px; wider images are divided by a whole number until they fit', 64, 8192)
    points: int = expert(
        300, 'points tracked at a time; 400 find the same turns and cost 20 % more', 50, 5000)
    use: str = expert(
        'information', 'of a gyro: in the solution where its scale is known, or a witness only',
        choices=('information', 'witness'))
    gyro_scale_sigma: float = expert(
        0.03, 'of its angles; cheap gyros are 1 to 3 % off, a calibrated one 0.001', 0.0, 1.0)
    standing_px: float = expert(
        0.3, 'px at the working width; the car stands when the median point moves less', 0.0, 5.0)
    spacing_s: float = expert(
        0.3, 's between the images of a triplet; few points survive a sharp turn', 0.05, 2.0)


@dataclass(frozen=True)
class MaskConfig:
    """The ego vehicle: what does not move while the rest of the picture does.

    Segmentation adds to the automatic mask; enabled = False leaves segmentation alone.
    """

    enabled: bool = setting(True, 'bonnet, pillars and burnt-in text spoil the matches (paper)')
    segmentation: str = setting(
        '', 'path of an ONNX model that finds the own car; empty: only the automatic mask')
    segmentation_classes: str = expert(
        '63,64', "the own car's classes; these are car mount and ego vehicle of Mapillary Vistas",
        pattern=r'\d{1,4}(, ?\d{1,4})*')
    segmentation_images: int = expert(
        15, 'images that vote; there is a mask from the first on', 1, 1000)
    segmentation_period_s: float = expert(
        2.0, 's of driving between two votes: the traffic has changed', 0.0, 600.0)


@dataclass(frozen=True)
class TurnsConfig:
    """epipole distances -> turns -> the bank of the best."""

    wanted: int = setting(
        5, 'turns; the paper: focal lengths settle at 2, the centre at 4, distortion at 5', 1, 20)
    at_most: int = setting(
        8, 'turns used where those wanted leave the result weak', 1, 50)
    half_width: float = expert(
        3.0, "s kept on either side of a turn's centre: the paper's k = 30 frames at 10 fps",
        0.5, 10.0)
    store: str = setting(
        '', 'folder for reconstructed turns of one camera: short trips add up; empty: none')
    capacity: int = expert(10, 'turns kept at the most: twice those wanted', 1, 50)
    min_prominence: float = expert(
        0.0025, 'of the image width; lower peaks of the turning magnitude are no turns', 0.0, 1.0)


@dataclass(frozen=True)
class TracksConfig:
    """A turn's images -> correspondences between its keyframes."""

    points: int = expert(800, 'points tracked at a time', 100, 10000)
    keyframe_motion: float = expert(
        0.03, 'of the image width; the median point moves so far between keyframes', 0.0, 1.0)


@dataclass(frozen=True)
class SceneConfig:
    """Tracks -> one scene per turn."""

    tracks: int = expert(
        1000, 'tracks used of a turn, the longest where others are few', 50, 10000)
    profile_tracks: int = expert(300, 'longest tracks used for the focal profile', 50, 5000)
    keyframes: int = expert(
        30, 'of a turn at the most; more cost time and change nothing', 5, 1000)
    profile_keyframes: int = expert(12, 'of a turn at the most, for the focal profile', 5, 1000)
    min_images: int = expert(6, 'a turn with fewer keyframes is not tried', 4, 100)
    error_px: float = expert(2.0, 'px; an observation farther off is not used', 0.2, 20.0)
    chain_error: float = expert(
        0.004, 'of the width; the same while the lens is still unknown', 0.0005, 0.05)
    min_angle_deg: float = expert(
        0.3, 'degrees; rays that meet at less give no point: far points show a turn best',
        0.01, 10.0)
    loss_px: float = expert(0.5, 'px; scale of the Cauchy loss', 0.05, 10.0)
    iterations: int = expert(
        12, 'of one adjustment; 60 move fx by 0.03 % at the most, at twice the time', 5, 500)
    min_explained: float = expert(
        0.3, "of a turn's observations; a turn of which the camera explains fewer is dropped",
        0.0, 0.9)


@dataclass(frozen=True)
class IntrinsicsConfig:
    """Scenes -> the parameters of the lens."""

    loss: float = expert(
        1.0, 'times the median reprojection error; scale of the Cauchy loss', 0.1, 100.0)
    profile_tracks: int = expert(
        120, 'of each turn, for the focal profile around the result', 20, 5000)
    aspect_sigma: float = expert(
        0.003, 'fy / fx is 1 to within this: planar turns know fx but hardly fy', 1e-5, 1.0)
    crop_rounds: int = expert(
        10, 'corrections of a stabilised picture at the most; with 0 none is taken out', 0, 100)


@dataclass(frozen=True)
class MountConfig:
    """How the camera sits on the car."""

    enabled: bool = expert(True, 'yaw, pitch and roll cost less than a second')
    speed_kmh: float = setting(
        0.0, 'km/h; constant on straight stretches: tells the height; 0 where it is unknown',
        0.0, 300.0)


@dataclass(frozen=True)
class LinesConfig:
    """Upright lines of the world: poles and the edges of houses, a second witness."""

    images: int = expert(
        300, 'searched at the most; when there are more, every second one is dropped', 10, 10000)
    group_s: float = expert(
        5.0, 's; images of so long a time may show the same line, and count as one witness',
        0.1, 600.0)


@dataclass(frozen=True)
class VerdictConfig:
    """When a result is weak or refused."""

    max_sigma: float = setting(0.015, 'sigma of fx, of fx; more is weak', 0.0, 1.0)
    min_turns: int = expert(2, 'turns; fewer are weak: focal lengths settle at 2 (paper)', 1, 20)
    min_yaw_deg: float = expert(60.0, 'degrees over all turns; less is weak', 0.0, 1000.0)
    refused_yaw_deg: float = expert(
        10.0, 'degrees over all turns; less is refused', 0.0, 1000.0)
    min_contrast: float = expert(
        0.05, 'relative rise of the error 20 % off the focal length; less is weak', 0.0, 10.0)
    max_roll_deg: float = expert(
        45.0, 'degrees; pictures turned more are weak; 180 for a camera mounted so', 0.0, 180.0)
    max_aspect: float = expert(
        0.015, 'fy / fx farther from 1 is weak; a rolling shutter of 20 ms made it 0.04', 0.0, 1.0)
    max_disagreement: float = expert(
        0.03, 'of fx; weighted scatter between the turns, more is weak', 0.0, 1.0)
    max_leverage: float = expert(
        0.9, 'of the information about fx; the others cannot confirm a turn that gives more',
        0.0, 1.0)
    max_line_sigmas: float = expert(
        4.0, 'of both; where straight lines ask for another k1 by more, the result is weak',
        1.0, 1e6)
    max_misfit: float = expert(
        2.0, "times a turn's cost with a camera of its own; more is weak: another lens", 1.0, 1e4)
    max_crop_sigmas: float = expert(
        2.0, 'over the picture; a picture that a stabiliser moves farther is weak', 0.0, 1e6)


@dataclass(frozen=True)
class FleetConfig:
    """Many cameras: dashcalib batch."""

    turns: int = expert(
        20, 'of one camera at the most; a clip with one bend knows a little, twenty much', 1, 200)
    attempts: int = expert(
        3, 'of a clip that kills its worker; then it is set aside, and others go on', 1, 100)
    memory_mb: int = expert(
        1200, 'MB declared for a task; measured: 250 MB, and up to 8 turns of 1440 px', 1, 2**20)
    least_units: int = expert(
        8, 'cameras of one make, beside the one it is for; fewer give it no prior', 3, 10**6)
    other_mode: float = expert(
        3.0, 'sigmas off the fx of its make; a unit farther off is in another sensor mode',
        1.0, 1e3)


@dataclass(frozen=True)
class MonitorConfig:
    """Whether a camera in use has changed since, turn by turn."""

    turns: int = expert(
        8, 'newest turns that are looked at: a change shows within three of them', 3, 100)
    limit: float = expert(
        25.0, 'of the evidence for another lens, a chi-squared of 3; chance: once in 60000',
        0.0, 1e6)
    turn_limit: float = expert(
        4.0, 'of one turn, the same: two sigma', 0.0, 1e6)
    max_misfit: float = expert(
        1.3, "times a turn's cost with its own camera; in 88 turns of one camera: 1.21 at most",
        1.0, 1e4)
    heading_limit: float = expert(
        4.0, 'sigmas between the directions of travel before and after the camera was moved',
        0.0, 100.0)


@dataclass(frozen=True)
class Config:
    """All settings; frozen. Config().replace({'turns.wanted': 8}) returns a copy with changes.

    Config.from_mapping() takes what a YAML file has, flat() gives every setting by its full name.
    Raises ConfigError for a value of the wrong type, NaN or out of range.
    """

    seed: int = expert(0, 'same input and seed: same result', 0, 2**31 - 1)
    threads: int = setting(
        2, 'processes that reconstruct turns side by side; the result is the same with any', 1, 64)
    model: str = setting(
        'auto', 'of the lens: radial, brown or fisheye; auto: the one that the turns prove')
    rectified: str = setting(
        'same', 'view of rectified pictures, P: as K, without black border, or all up to 75 deg',
        choices=('same', 'crop', 'all'))
    max_width: int = expert(
        1440, 'px; wider images are halved until they fit: time and memory fall by four',
        320, 16384)
    min_width: int = expert(
        640, 'px; narrower images are enlarged 2, 3 or 4 times: limits in px fit them, too',
        1, 4096)
    motion: MotionConfig = field(default_factory=MotionConfig)
    mask: MaskConfig = field(default_factory=MaskConfig)
    turns: TurnsConfig = field(default_factory=TurnsConfig)
    tracks: TracksConfig = field(default_factory=TracksConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    intrinsics: IntrinsicsConfig = field(default_factory=IntrinsicsConfig)
    lines: LinesConfig = field(default_factory=LinesConfig)
    mount: MountConfig = field(default_factory=MountConfig)
    verdict: VerdictConfig = field(default_factory=VerdictConfig)
    monitor: MonitorConfig = field(default_factory=MonitorConfig)
    fleet: FleetConfig = field(default_factory=FleetConfig)

    def __post_init__(self) -> None:
        for name, spec, value in _settings(self):
            _check(name, spec, value)

    def flat(self) -> dict[str, Any]:
        """Return every setting by its full name, in order."""
        return {name: value for name, _, value in _settings(self)}

    def replace(self, changes: Mapping[str, Any]) -> Config:
        """Return a copy with settings changed by full name; raises ConfigError."""
        known = {name: spec for name, spec, _ in _settings(self)}
        top: dict[str, Any] = {}
        nested: dict[str, dict[str, Any]] = {}
        for name, value in changes.items():
            if name not in known:
                near = difflib.get_close_matches(name, known, 1)
                hint = f': did you mean {near[0]}?' if near else f'; there are {", ".join(known)}'
                raise ConfigError(f'unknown setting {name!r}{hint}')
            section, _, key = name.rpartition('.')
            # an integer is a fine float, and a fine text: YAML reads 13 as one, and 1e-3 as a text
            kind = type(known[name].default)
            if kind in (float, str) and (isinstance(value, str) or _is_exact(value)):
                with contextlib.suppress(ValueError):
                    value = kind(value)
            (nested.setdefault(section, {}) if section else top)[key] = value
        for section, values in nested.items():
            top[section] = dataclasses.replace(getattr(self, section), **values)
        return dataclasses.replace(self, **top)

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any]) -> Config:
        """Make a Config from nested or dotted names, as a YAML file gives them."""
        flat: dict[str, Any] = {}
        for key, value in data.items():
            if isinstance(value, Mapping):
                flat.update({f'{key}.{inner}': item for inner, item in value.items()})
            elif value is None and dataclasses.is_dataclass(getattr(cls(), str(key), None)):
                continue  # a section of which every line is a comment
            else:
                flat[str(key)] = value
        return cls().replace(flat)


def describe() -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """Yield (full name, field) of every setting, those for experts after the others.

    Not those of FleetConfig: one drive, and the node, have no use for them. field.metadata has
    reason, minimum, maximum, choices, pattern and expert.
    """
    for wanted in (False, True):
        for name, spec, _ in _settings(Config()):
            if spec.metadata['expert'] is wanted and not name.startswith('fleet.'):
                yield name, spec


def _settings(config: Config) -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    for outer in dataclasses.fields(config):
        value = getattr(config, outer.name)
        if dataclasses.is_dataclass(value):
            for inner in dataclasses.fields(value):
                yield f'{outer.name}.{inner.name}', inner, getattr(value, inner.name)
        else:
            yield outer.name, outer, value


def _is_exact(value: Any) -> bool:
    # int and not bool, and no larger than a float can hold
    return type(value) is int and abs(value) <= 2**53


def _check(name: str, spec: dataclasses.Field[Any], value: Any) -> None:
    expected = type(spec.default)
    if type(value) is not expected and not (expected is float and _is_exact(value)):
        raise ConfigError(f'{name} must be {expected.__name__}, not {value!r}')
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f'{name} must be a finite number, not {value!r}')
    low, high = spec.metadata['minimum'], spec.metadata['maximum']
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{name} must be between {low:g} and {high:g}, not {value!r}')
    choices = spec.metadata['choices']
    if choices and value not in choices:
        raise ConfigError(f'{name} must be one of {", ".join(choices)}, not {value!r}')
    if spec.metadata['pattern'] and not re.fullmatch(spec.metadata['pattern'], value):
        raise ConfigError(f'{name} must look like {spec.default}, not {value!r}')
