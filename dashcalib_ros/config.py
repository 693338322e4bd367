# SPDX-License-Identifier: Apache-2.0
"""The one home of every default, each with the reason for its value.

Users set about fifteen of them, setting(); the others are for experts, expert(). The measurements
behind a value are in benchmark/settings.md.

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
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, TypeVar

from dashcalib_ros.errors import ConfigError, shortened

T = TypeVar('T')
# names that an unknown setting is answered with
NEAREST = 3
# of what is known
NUMBER = r'\d+(\.\d*)?'


def setting(default: T, reason: str, minimum: float | None = None, maximum: float | None = None,
            choices: tuple[str, ...] = (), pattern: str = '', *, expert: bool = False) -> T:
    """Declare a setting: its default, the reason for it in one line, and the other valid values.

    expert: few users set it; such settings are listed after the others. The measurements behind a
    value are in benchmark/settings.md under the setting's name.
    """
    metadata = {'reason': reason, 'minimum': minimum, 'maximum': maximum, 'choices': choices,
                'pattern': pattern, 'expert': expert}
    value: T = field(default=default, metadata=metadata)
    return value


# declares a setting for experts
expert = functools.partial(setting, expert=True)


@dataclass(frozen=True)
class TrackingConfig:
    """frames -> tracks -> epipoles, for detection only (calibration tracks again, finer)."""

    rate: float = setting(
        10.0, 'image rate in Hz; images of faster cameras are skipped; the paper uses 10 Hz',
        1.0, 60.0)
    width: int = expert(
        640, 'px; the width of wider images is divided by a whole number until it fits', 64, 8192)
    points: int = expert(
        300, 'points tracked at a time; 400 find the same turns and take 20 % longer', 50, 5000)
    standing_px: float = expert(
        0.3, 'px at the working width; the car stands if the median point moves less', 0.0, 5.0)


@dataclass(frozen=True)
class MotionConfig:
    """The car's own sensors."""

    use: str = expert(
        'information', 'use of a gyro: in the solution if its scale is known, or only as a check',
        choices=('information', 'witness'))
    gyro_scale_sigma: float = expert(
        0.03, 'standard deviation (sigma) of the gyro scale; 0.01 to 0.03, calibrated: 0.001',
        0.0, 1.0)


@dataclass(frozen=True)
class MaskConfig:
    """The ego vehicle: what does not move while the rest of the picture does.

    Segmentation adds to the automatic mask; enabled = False leaves segmentation alone.
    """

    enabled: bool = setting(
        True, 'ignore bonnet, pillars and text overlays, which cause wrong matches (paper)')
    segmentation: str = setting(
        '', 'path of an ONNX model that segments the ego vehicle; empty: only the automatic mask')
    segmentation_classes: str = expert(
        '63,64', 'classes of the ego vehicle; here: car mount, ego vehicle of Mapillary Vistas',
        pattern=r'\d{1,4}(, ?\d{1,4})*')


@dataclass(frozen=True)
class TurnsConfig:
    """epipole distances -> turns -> the bank of the best."""

    wanted: int = setting(
        5, 'turns; paper: focal lengths converge with 2, the centre with 4, distortion with 5',
        1, 20)
    at_most: int = setting(
        8, 'maximum number of turns, used if the result of turns.wanted turns is weak', 1, 50)
    stretches: int = expert(
        8, 'other stretches used if turns are few or a result is weak: they know fx to 1 to 4 %',
        0, 100)
    thorough: bool = setting(
        False, 'use these stretches even where turns are enough: a smaller sigma, more time')
    half_width: float = expert(
        3.0, "s kept on each side of a turn's centre; k = 30 frames at 10 Hz in the paper",
        0.5, 10.0)
    store: str = setting(
        '', 'folder for reconstructed turns of one camera: short trips add up; empty: none')
    capacity: int = expert(10, 'maximum number of turns kept: twice turns.wanted', 1, 50)


@dataclass(frozen=True)
class KnownConfig:
    """What somebody knows about the camera; with a sigma after ±, else it counts as exact."""

    stabiliser: str = setting(
        '', "no: the pictures are not stabilised, so that bumps and gentle bends count; '': not "
        'known', choices=('', 'no'))
    shutter: str = setting(
        '', 'global, or the time from the first row to the last: 24ms, 24±2ms',
        pattern=rf'(global|{NUMBER}(±{NUMBER})? ?ms)?')
    fx: str = setting(
        '', 'px, of the pictures as they are: 1160±20', pattern=rf'({NUMBER}±{NUMBER})?')
    hfov: str = setting(
        '', 'degrees from the left edge to the right one: 120±5',
        pattern=rf'({NUMBER}±{NUMBER})?')
    aspect: str = setting(
        '', 'fy / fx: 1, 1±0.001', pattern=rf'({NUMBER}(±{NUMBER})?)?')
    height: str = setting(
        '', 'm above the road: 1.45±0.03; determines fx with a speed, and the metres of a rig',
        pattern=rf'({NUMBER}(±{NUMBER})?)?')


@dataclass(frozen=True)
class TracksConfig:
    """A turn's images -> correspondences between its keyframes."""

    points: int = expert(800, 'points tracked at a time', 100, 10000)
    keyframe_motion: float = expert(
        0.03, 'fraction of the image width; motion of the median point between keyframes',
        0.0, 1.0)


# engines of reconstruct.engine
COLMAP, OPENCV = 'pycolmap', 'opencv'


@dataclass(frozen=True)
class ReconstructConfig:
    """What a turn is reconstructed with."""

    engine: str = expert(
        'auto', 'library that estimates poses; auto: pycolmap where it is installed, else opencv',
        choices=('auto', COLMAP, OPENCV))

    def __post_init__(self) -> None:
        if self.engine == COLMAP and not self._has_colmap:
            raise ConfigError('E-ENGINE-MISSING', 'reconstruct.engine is pycolmap, which is not '
                              'installed: pip install pycolmap, or use auto or opencv')

    @property
    def used(self) -> str:
        """Return the engine that is used on this computer, COLMAP or OPENCV; loads none."""
        if self.engine == 'auto':
            return COLMAP if self._has_colmap else OPENCV
        return self.engine

    @property
    def _has_colmap(self) -> bool:
        return find_spec(COLMAP) is not None


@dataclass(frozen=True)
class SceneConfig:
    """Tracks -> one scene per turn."""

    tracks: int = expert(
        1000, 'tracks used per turn, the longest ones first where tracks are sparse', 50, 10000)
    profile_tracks: int = expert(
        300, 'longest tracks of a turn that the focal profile uses', 50, 5000)
    keyframes: int = expert(
        30, 'maximum number per turn; more take longer and do not change the result', 5, 1000)
    profile_keyframes: int = expert(12, 'maximum number per turn, for the focal profile', 5, 1000)
    error_px: float = expert(
        2.0, 'px; observations with a larger reprojection error are not used', 0.2, 20.0)
    min_angle_deg: float = expert(
        0.3, 'degrees; minimum triangulation angle of a point; far points show rotation best',
        0.01, 10.0)
    loss_px: float = expert(
        0.5, 'px; scale of the Cauchy loss of the reprojection errors', 0.05, 10.0)
    min_explained: float = expert(
        0.3, "minimum fraction of a turn's observations that the camera must explain",
        0.0, 0.9)


@dataclass(frozen=True)
class IntrinsicsConfig:
    """Scenes -> the parameters of the lens."""

    loss: float = expert(
        0.5, 'scale of the Cauchy loss, as a factor of the median reprojection error', 0.1, 100.0)
    profile_tracks: int = expert(
        120, 'tracks per turn for the focal profile around the result', 20, 5000)
    aspect_sigma: float = expert(
        0.003, 'sigma of fy / fx around 1: planar turns determine fx well, but fy poorly',
        1e-5, 1.0)
    crop_rounds: int = expert(
        10, 'maximum number of corrections of a stabilised image; 0: no correction', 0, 100)


@dataclass(frozen=True)
class MountConfig:
    """How the camera sits on the car."""

    enabled: bool = expert(
        True, 'determine yaw, pitch and roll of the camera; takes less than a second')
    speed_kmh: float = setting(
        0.0, 'km/h; constant speed on straight roads, for the camera height; 0: unknown',
        0.0, 300.0)


@dataclass(frozen=True)
class VerdictConfig:
    """When a result is weak or refused."""

    max_sigma: float = setting(
        0.015, 'maximum standard deviation (sigma) of fx, as a fraction of fx; above: weak',
        0.0, 1.0)
    min_turns: int = expert(
        2, 'minimum number of turns; fewer: weak; focal lengths converge with 2 (paper)', 1, 20)
    min_yaw_deg: float = expert(
        60.0, 'degrees; minimum sum of the yaw angles of all turns; below: weak', 0.0, 1000.0)
    max_roll_deg: float = expert(
        45.0, 'degrees; maximum roll of the images; above: weak; 180: for a rotated camera',
        0.0, 180.0)
    max_aspect: float = expert(
        0.015, 'maximum difference of the ratio fy / fx from 1; above: weak; 20 ms rolling '
               'shutter: 0.04', 0.0, 1.0)
    max_leverage: float = expert(
        0.9, 'maximum share of one turn in the information about fx; above: weak',
        0.0, 1.0)
    max_line_sigmas: float = expert(
        4.0, 'sigmas; maximum difference from the k1 of straight lines; above: weak',
        1.0, 1e6)
    max_crop_sigmas: float = expert(
        2.0, 'sigmas over the image; maximum motion by a stabiliser; above: weak', 0.0, 1e6)


@dataclass(frozen=True)
class RigConfig:
    """Several cameras of one car: largest sigmas of what is accepted; up to ten times is weak."""

    rotation_deg: float = expert(
        0.2, 'degrees about an axis; at 20 m it is 7 cm, and mountings are known no better',
        0.01, 5.0)
    translation_m: float = expert(
        0.1, 'm along an axis; a tape measure is as good', 0.001, 5.0)
    clock_s: float = expert(
        0.005, 's; at 20 m/s it is 10 cm, and half the time between rows of most shutters',
        1e-4, 1.0)


@dataclass(frozen=True)
class FleetConfig:
    """Many cameras: dashcalib batch."""

    turns: int = expert(
        20, 'maximum number of turns per camera; one bend contributes little, twenty much',
        1, 200)
    attempts: int = expert(
        3, 'attempts for a clip that kills its worker; after them, the clip is skipped',
        1, 100)
    memory_mb: int = expert(
        1200, 'MB declared per task; measured: 250 MB at the start, more with 8 turns of 1440 px',
        1, 2**20)
    least_units: int = expert(
        8, 'minimum number of other cameras of the same model, for a prior of one camera',
        3, 10**6)


@dataclass(frozen=True)
class MonitorConfig:
    """Whether a camera in use has changed since, turn by turn."""

    turns: int = expert(
        8, 'newest turns that are compared; a change is visible within three of them', 3, 100)
    limit: float = expert(
        25.0, 'chi-squared (3 degrees of freedom) of another lens; by chance once in 60000',
        0.0, 1e6)
    turn_limit: float = expert(
        4.0, 'the same for one turn: two sigma', 0.0, 1e6)
    max_misfit: float = expert(
        1.3, "maximum ratio of a turn's cost to that with its own camera; 1.21 in 88 turns",
        1.0, 1e4)
    heading_limit: float = expert(
        4.0, 'sigmas between the directions of travel before and after the camera moved',
        0.0, 100.0)


# settings by their earlier names, which are read, too
RENAMED = {'threads': 'workers', **{f'motion.{name}': f'tracking.{name}' for name in (
    'rate', 'width', 'points', 'standing_px')}}


@dataclass(frozen=True)
class Config:
    """All settings; frozen. Config.of({'turns.wanted': 8}, seed=1) has these, and the defaults.

    replace() returns a copy with changes; flat() returns all settings by name. Raises ConfigError
    for a value that has the wrong type, is NaN or is out of range.
    """

    seed: int = expert(
        0, 'random seed; the same input and seed give the same result', 0, 2**31 - 1)
    workers: int = setting(
        2, 'processes that reconstruct turns in parallel; the result does not depend on it', 1, 64)
    model: str = setting(
        'auto', 'lens model: radial, brown or fisheye; auto: the one that the turns support')
    rectified: str = setting(
        'same', 'view of rectified images, P: same as K, no black border, or all up to 75 degrees',
        choices=('same', 'crop', 'all'))
    max_width: int = expert(
        1440, 'px; wider images are halved until they fit, at a quarter of the time and memory',
        320, 16384)
    min_width: int = expert(
        640, 'px; narrower images are enlarged 2, 3 or 4 times, so that limits in px fit',
        1, 4096)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    mask: MaskConfig = field(default_factory=MaskConfig)
    known: KnownConfig = field(default_factory=KnownConfig)
    turns: TurnsConfig = field(default_factory=TurnsConfig)
    tracks: TracksConfig = field(default_factory=TracksConfig)
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    intrinsics: IntrinsicsConfig = field(default_factory=IntrinsicsConfig)
    mount: MountConfig = field(default_factory=MountConfig)
    verdict: VerdictConfig = field(default_factory=VerdictConfig)
    monitor: MonitorConfig = field(default_factory=MonitorConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    fleet: FleetConfig = field(default_factory=FleetConfig)

    def __post_init__(self) -> None:
        for group in dataclasses.fields(self):
            value = getattr(self, group.name)
            if isinstance(group.default_factory, type) and not isinstance(
                    value, group.default_factory):
                raise ConfigError('E-CONFIG-TYPE', f'{group.name} is a group of settings: use '
                                  f"Config.of({{'{group.name}.NAME': VALUE}}), not {value!r:.80}")
        for name, spec, value in _settings(self):
            _check(name, spec, value)

    @property
    def threads(self) -> int:
        """Return workers, by its earlier name."""
        return self.workers

    def flat(self) -> dict[str, Any]:
        """Return every setting by its full name, in order."""
        return {name: value for name, _, value in _settings(self)}

    def replace(self, changes: Mapping[str, Any]) -> Config:
        """Return a copy with settings changed by name: nested or dotted, as in a YAML file.

        Raises ConfigError.
        """
        known = {name: spec for name, spec, _ in _settings(self)}
        top: dict[str, Any] = {}
        nested: dict[str, dict[str, Any]] = {}
        for name, value in _dotted(changes, known):
            if name not in known:
                near = difflib.get_close_matches(name, known, NEAREST, 0.0)
                raise ConfigError('E-CONFIG-UNKNOWN', f'unknown setting {name!r}: did you mean '
                                  f'{", ".join(near[:-1])} or {near[-1]}?')
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
    def of(cls, settings: Config | Mapping[str, Any] | None = None, /, **more: Any) -> Config:
        """Return a Config: the one given, or the defaults with the settings of a mapping.

        settings: names may be nested or dotted, as in a YAML file. more: further settings, such as
        model='fisheye'. Raises ConfigError.
        """
        config = settings if isinstance(settings, Config) else cls().replace(
            {} if settings is None else settings)
        return config.replace(more) if more else config


def known_of(pairs: Iterable[str]) -> dict[str, str]:
    """Return the settings that NAME=VALUE pairs of what somebody knows mean; raises ConfigError.

    They are not checked yet.
    """
    changes = {}
    for pair in pairs:
        name, equals, text = pair.partition('=')
        if not equals:
            raise ConfigError('E-KNOWN-FORM', f'what is known needs NAME=VALUE, such as '
                                              f'stabiliser=no, not {shortened(pair)!r}')
        changes[f'known.{name.strip()}'] = text.strip().replace('+-', '±')
    return changes


def _dotted(changes: Mapping[str, Any], known: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the settings of a mapping, each with its full name. Raises ConfigError."""
    if not isinstance(changes, Mapping):
        raise ConfigError('E-CONFIG-TYPE', f"settings must be a mapping such as "
                                           f"{{'turns.wanted': 8}}, not {changes!r:.80}")
    groups = {group.name for group in dataclasses.fields(Config)} - {*known}
    for key, value in changes.items():
        if isinstance(value, Mapping) and key not in known:
            yield from ((present_name(f'{key}.{inner}'), item) for inner, item in value.items())
        # None: a group of which every line is a comment
        elif value is not None or key not in groups:
            yield present_name(str(key)), value


def present_name(name: str) -> str:
    """Return a setting's name; one that was renamed since may have its earlier one."""
    if name not in RENAMED:
        return name
    warnings.warn(f'the setting {name} is called {RENAMED[name]} now', FutureWarning, 2)
    return RENAMED[name]


def describe() -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """Yield (full name, field) of every setting, those for experts after the others.

    Not those of FleetConfig and RigConfig: one camera, and the node, have no use for them.
    field.metadata has reason, minimum, maximum, choices, pattern and expert.
    """
    for wanted in (False, True):
        for name, spec, _ in _settings(Config()):
            if spec.metadata['expert'] is wanted and not name.startswith(('fleet.', 'rig.')):
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
        raise ConfigError('E-CONFIG-TYPE',
                          f'{name} must be of type {expected.__name__}, not {value!r}')
    # NaN is allowed where it stands for 'not known', as a default
    unknown = isinstance(value, float) and math.isnan(value) and spec.default != spec.default
    if isinstance(value, float) and not (unknown or math.isfinite(value)):
        raise ConfigError('E-CONFIG-FINITE', f'{name} must be a finite number, not {value!r}')
    low, high = spec.metadata['minimum'], spec.metadata['maximum']
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError('E-CONFIG-RANGE',
                          f'{name} must be between {low:g} and {high:g}, not {value!r}')
    choices = spec.metadata['choices']
    if choices and value not in choices:
        raise ConfigError('E-CONFIG-CHOICE',
                          f'{name} must be one of {", ".join(choices)}, not {value!r}')
    if spec.metadata['pattern'] and not re.fullmatch(spec.metadata['pattern'], value):
        raise ConfigError('E-CONFIG-PATTERN',
                          f'{name} must have the form of {spec.default}, not {value!r}')
