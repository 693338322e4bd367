# SPDX-License-Identifier: Apache-2.0
"""Settings: valid defaults with reasons, and one clear line for every value that does not fit."""
from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import pytest
import yaml
from refused import refused

from dashcalib_ros.config import (
    Config,
    TrackingConfig,
    TurnsConfig,
    VerdictConfig,
    _settings,
    describe,
)
from dashcalib_ros.errors import ConfigError

SPECS = {name: spec for name, spec, _ in _settings(Config())}


def test_defaults_are_inside_their_ranges_and_not_on_the_edge_of_types():
    flat = Config().flat()
    assert set(flat) == set(SPECS)
    for name, value in flat.items():
        meta = SPECS[name].metadata
        assert type(value) in (int, float, bool, str), name
        if isinstance(value, (bool, str)):
            continue
        assert meta['minimum'] <= value <= meta['maximum'], name


@pytest.mark.parametrize('name', SPECS)
def test_every_setting_says_why_in_one_line(name):
    reason = SPECS[name].metadata['reason']
    # longer ones do not fit into one line of config.py: benchmark/settings.md is their place
    assert 10 <= len(reason) <= 88 and '\n' not in reason


def test_about_twenty_settings_are_for_users_and_come_first():
    experts = [spec.metadata['expert'] for _, spec in describe()]
    assert experts == sorted(experts)
    users = {name for name in SPECS if not SPECS[name].metadata['expert']}
    assert 10 <= len(users) <= 22
    assert {'turns.wanted', 'turns.store', 'workers', 'tracking.rate'} <= users
    assert not {'scene.loss_px', 'intrinsics.loss', 'verdict.max_leverage'} & users


def test_what_was_measured_is_told_of_settings_that_exist_with_their_defaults():
    table = Path(__file__).parents[1] / 'benchmark' / 'settings.md'
    if not table.exists():
        pytest.skip('the source distribution has no benchmarks')
    text = table.read_text()
    rows = re.findall(r'^\| `([a-z_.0-9]+)` \| ([^|]+) \|', text, re.MULTILINE)
    constants = re.findall(r'^\| `([A-Z_]+)` in (\S+) \|', text, re.MULTILINE)
    assert len(rows) + len(constants) > 20
    for name, default in rows:
        shown = str(SPECS[name].default) or 'none'
        assert default == shown, name
    for name, path in constants:
        module = Path(__file__).parents[1] / 'dashcalib_ros' / path
        assert re.search(rf'^([A-Z_]+, )*{name}\b.* = ', module.read_text(), re.MULTILINE), name


@pytest.mark.parametrize('name', [n for n, s in SPECS.items() if isinstance(s.default, float)])
@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf])
def test_not_a_finite_number(name, value):
    with refused(ConfigError, 'E-CONFIG-FINITE', name):
        Config().replace({name: value})


@pytest.mark.parametrize(
    'name', [n for n, s in SPECS.items() if not isinstance(s.default, (bool, str))])
def test_out_of_range_names_the_range(name):
    meta = SPECS[name].metadata
    kind = type(SPECS[name].default)
    for value in (meta['minimum'] - 1, meta['maximum'] + 1):
        with refused(ConfigError, 'E-CONFIG-RANGE', name, f'{meta["minimum"]:g} and'):
            Config().replace({name: kind(value)})
    for value in (meta['minimum'], meta['maximum']):
        assert Config().replace({name: kind(value)}).flat()[name] == value


@pytest.mark.parametrize(('name', 'value'), [
    ('turns.wanted', 2.5), ('turns.wanted', '5'), ('turns.wanted', True), ('turns.wanted', None),
    ('tracking.rate', 'fast'), ('tracking.rate', True), ('tracking.rate', None),
    ('tracking.rate', [10.0]),
    ('mask.enabled', 1), ('mask.enabled', 'yes'), ('seed', 1.0), ('seed', False),
    ('tracking.rate', {'hz': 10}), ('mask.segmentation', None), ('mask.segmentation', True),
    ('mask.segmentation_classes', [63, 64]),
])
def test_wrong_type_names_the_right_one(name, value):
    with refused(ConfigError, 'E-CONFIG-TYPE', name, type(SPECS[name].default).__name__):
        Config().replace({name: value})


@pytest.mark.parametrize(('name', 'hint'), [
    ('turns.half_with', 'turns.half_width'), ('turn.wanted', 'turns.wanted'), ('sed', 'seed'),
    ('tracking.Rate', 'tracking.rate')])
def test_a_typo_gets_the_nearest_name(name, hint):
    with refused(ConfigError, 'E-CONFIG-UNKNOWN', f'did you mean {hint}, '):
        Config().replace({name: 1})


def test_a_name_like_no_other_gets_the_three_nearest():
    with refused(ConfigError, 'E-CONFIG-UNKNOWN') as caught:
        Config().replace({'qqqqqqqqqqqqqq': 1})
    named = re.findall(r'[a-z_.]+', str(caught.value).partition('did you mean ')[2])
    assert len(set(named) & set(SPECS)) == 3 and len(named) == 4


@pytest.mark.parametrize(
    'name', ['__class__', 'turns', 'flat', 'turns.', '.', '', 'turns.wanted.x'])
def test_names_that_are_attributes_but_no_settings(name):
    with refused(ConfigError, 'E-CONFIG-UNKNOWN'):
        Config().replace({name: 1})


def test_an_integer_is_a_fine_float():
    config = Config().replace({'tracking.rate': 10, 'turns.half_width': 2})
    assert type(config.tracking.rate) is float and config.tracking.rate == 10.0
    assert type(config.turns.half_width) is float


def test_an_integer_is_a_fine_float_in_yaml_and_in_python():
    text = 'tracking: {rate: 12}\nverdict:\n  min_yaw_deg: 70\nturns.half_width: 2\n'
    config = Config.of(yaml.safe_load(text))
    assert (config.tracking.rate, config.verdict.min_yaw_deg) == (12, 70)
    assert config.turns.half_width == 2
    made = Config(tracking=TrackingConfig(rate=12), turns=TurnsConfig(half_width=2),
                  verdict=VerdictConfig(min_yaw_deg=70))
    assert made == config
    assert type(made.replace({'tracking.rate': 15}).tracking.rate) is float


@pytest.mark.parametrize('value', [10**30, -10**400])
def test_an_integer_that_no_float_can_hold(value):
    with refused(ConfigError, 'E-CONFIG-TYPE', 'tracking.rate'):
        Config().replace({'tracking.rate': value})
    with refused(ConfigError, 'E-CONFIG-TYPE', 'tracking.rate'):
        Config(tracking=TrackingConfig(rate=value))


def test_a_renamed_setting_is_read_with_a_warning():
    with pytest.warns(FutureWarning, match='workers'):
        config = Config.of({'threads': 3})
    assert config.workers == config.threads == 3 and 'threads' not in config.flat()
    for settings in ({'motion.rate': 8.0}, {'motion': {'rate': 8.0, 'use': 'witness'}}):
        with pytest.warns(FutureWarning, match=r'motion\.rate is called tracking\.rate now'):
            assert Config.of(settings).tracking.rate == 8.0


def test_a_config_made_directly_is_checked_too():
    with refused(ConfigError, 'E-CONFIG-RANGE', 'turns.wanted'):
        Config(turns=TurnsConfig(wanted=0))
    with refused(ConfigError, 'E-CONFIG-RANGE', 'workers'):
        Config(workers=0)
    with refused(ConfigError, 'E-CONFIG-FINITE', 'tracking.rate'):
        Config(tracking=TrackingConfig(rate=math.nan))


def test_a_group_is_no_setting():
    for wrong in (8, {'wanted': 8}, VerdictConfig()):
        with refused(ConfigError, 'E-CONFIG-TYPE', 'Config.of('):
            Config(turns=wrong)


def test_of_takes_a_config_a_mapping_and_more():
    eight = Config.of({'turns.wanted': 8}, seed=2)
    assert eight == Config().replace({'turns': {'wanted': 8}, 'seed': 2}) == Config.of(eight)
    assert Config.of() == Config.of(None) == Config() and Config.of(eight, seed=0).seed == 0
    assert Config.of(turns={'wanted': 8}, seed=2) == eight
    for wrong in (3, 'settings.yaml', ['turns.wanted'], {3: 4}):
        with refused(ConfigError, 'E-CONFIG-UNKNOWN' if wrong == {3: 4} else 'E-CONFIG-TYPE'):
            Config.of(wrong)


def test_nested_and_dotted_names_mean_the_same():
    nested = Config.of({'turns': {'wanted': 3, 'half_width': 2.0}, 'seed': 7})
    dotted = Config.of({'turns.wanted': 3, 'turns.half_width': 2.0, 'seed': 7})
    assert nested == dotted
    assert (nested.turns.wanted, nested.turns.half_width, nested.seed) == (3, 2.0, 7)
    # what was not named keeps its default
    assert nested.turns.capacity == Config().turns.capacity


def test_a_section_without_lines_is_no_error():
    data = yaml.safe_load('turns:\n  # wanted: 3\nseed: 4\n')
    assert Config.of(data) == Config().replace({'seed': 4})


@pytest.mark.parametrize('data', [{'turns': 5}, {'turns': {'wanted': {'x': 1}}}, {3: 4},
                                  {'turns': {None: 1}}, {'nothing': None}])
def test_yaml_of_another_shape(data):
    with pytest.raises(ConfigError):
        Config.of(data)


def test_replace_leaves_the_original_alone():
    config = Config()
    before = config.flat()
    changed = config.replace({'turns.wanted': 2, 'seed': 5})
    assert config.flat() == before and config == Config()
    assert (changed.turns.wanted, changed.seed) == (2, 5)
    assert {name for name, value in changed.flat().items() if value != before[name]} == {
        'turns.wanted', 'seed'}
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.seed = 3
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.turns.wanted = 3


def test_what_flat_gives_makes_the_same_config_again():
    config = Config().replace({'turns.wanted': 7, 'mask.enabled': False, 'tracking.rate': 8})
    assert Config.of(config.flat()) == config
