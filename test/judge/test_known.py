# SPDX-License-Identifier: Apache-2.0
"""What somebody knows: it counts by its sigma, and not where the turns contradict it."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, scenes_of, solved
from synthetic import LENS, SIZE

from dashcalib_ros.config import Config, KnownConfig
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge.conclude import Evidence, conclude
from dashcalib_ros.judge.known import with_known
from dashcalib_ros.judge.verdict import judge, profile_contrast


def knowing(**pieces):
    return replace(CONFIG, known=KnownConfig(**pieces))


@pytest.fixture(scope='module')
def found():
    return solved(scenes_of(2))


@pytest.mark.parametrize(('name', 'text', 'value'), [
    ('fx', '519.9±0.3', 519.9), ('hfov', '81±0.1', 81.0), ('aspect', '1±0.0001', 1.0),
    ('shutter', 'global', 0.0), ('shutter', '0.1±0.2ms', 1e-4)])
def test_each_piece_makes_the_camera_better_known(found, name, text, value):
    informed, [piece] = with_known(found, knowing(**{name: text}), 1.0)
    assert piece.name == name and piece.value == pytest.approx(value)
    if piece.used:
        # which of the cases in sigma is likelier may change a little
        assert piece.fx_sigma <= 1.05 * piece.fx_sigma_without
        assert piece.fx_sigma_without == pytest.approx(found.sigma[0])
        assert informed.sigma[0] == pytest.approx(piece.fx_sigma)
    if name == 'fx':
        assert piece.used and piece.fx_sigma < 0.3
        assert abs(informed.camera.fx - 519.9) < abs(found.camera.fx - 519.9) + 1e-9
    if name == 'shutter':
        assert piece.used and abs(informed.readout_s - value) <= abs(found.readout_s - value)


def test_pixels_of_the_input_count(found):
    _, [piece] = with_known(found, knowing(fx='1040±10'), 2.0)
    assert piece.by_turns == pytest.approx(2 * found.camera.fx) and piece.used


def test_what_the_turns_contradict_does_not_count(found):
    informed, [piece] = with_known(found, knowing(fx='600±5'), 1.0)
    assert not piece.used and informed is found
    assert piece.fx_sigma == piece.fx_sigma_without


def test_one_turn_alone_contradicts_less_and_names_no_readout_so_soon(found):
    def used_and_named(solution, sigmas):
        readout_s = -sigmas * solution.readout_sigma_s
        [shutter] = with_known(
            replace(solution, readout_s=readout_s), knowing(shutter='global'), 1.0)[1]
        rolling = replace(solution, readout_s=-1e-3 * sigmas, readout_sigma_s=1e-3).rolling
        return shutter.used, rolling

    alone = solved(scenes_of(1))
    assert used_and_named(alone, 5) == (True, False)
    assert used_and_named(alone, 9) == used_and_named(found, 5) == (False, True)


def above(height_m):
    """Return what measures a height that is right with the true lens."""
    return lambda solution: (height_m * LENS.fx / solution.camera.fx, 0.01 * height_m)


def test_a_known_height_above_the_road_tells_the_focal_length(found):
    short = replace(found, written=replace(found.written, camera=found.camera.zoomed(0.97)),
                    posterior=found.posterior.erring_together(0.05))
    informed, [piece] = with_known(short, knowing(height='1.5±0.015'), 1.0, above(1.5))
    assert piece.used and piece.by_turns == pytest.approx(1.5 / 0.97, rel=0.01)
    assert abs(informed.camera.fx - LENS.fx) < 0.006 * LENS.fx
    assert informed.sigma[0] / LENS.fx == pytest.approx(np.hypot(0.01, 0.01), abs=0.002)
    assert piece.fx_sigma < 0.4 * piece.fx_sigma_without
    # what the turns say about it stays what they said
    assert informed.by_turns is short
    assert profile_contrast(informed) == profile_contrast(short)
    [wrong] = with_known(short, knowing(height='2±0.01'), 1.0, above(1.5))[1]
    assert not wrong.used
    # which is not measured without a speed
    assert with_known(short, knowing(height='1.5'), 1.0) == (short, ())
    [warning] = [each for each in conclude(
        found, Evidence(SIZE, 300, (), {}, np.zeros((0, 2)), None, FULL_SIZE, {}),
        knowing(height='1.5')).warnings if each.code == 'E-KNOWN-HEIGHT']
    assert '--motion' in str(warning)


def test_nothing_known_is_nothing_changed(found):
    assert with_known(found, CONFIG, 1.0) == (found, ())


@pytest.mark.parametrize(('name', 'text'), [
    ('fx', '1160'), ('fx', 'NaN±1'), ('shutter', '24'), ('shutter', 'rolling'), ('hfov', '120±'),
    ('stabiliser', 'yes'), ('aspect', '-1'), ('height', '-1.4'), ('height', '1.4m')])
def test_what_cannot_be_understood_is_refused(name, text):
    with pytest.raises(ConfigError):
        Config.of({f'known.{name}': text})


GENTLE = {'yaws': (9.0, -12.0, 8.0)}


def gentle(config: Config = CONFIG, sharp: bool = False):
    from synthetic import synthetic_turn
    yaws = (*GENTLE['yaws'], *((80.0,) if sharp else ()))
    return solved([synthetic_turn(LENS, yaw, tracks=180, keyframes=14, noise_px=0.25,
                                  world=world).scene(LENS, world)
                   for world, yaw in enumerate(yaws)], config)


@pytest.mark.thorough
def test_gentle_bends_may_be_a_stabiliser_s_unless_it_is_known_that_there_is_none():
    unknown = gentle()
    assert len(unknown.perhaps_shifted) == 3 and not unknown.crops
    assert 'E-ONLY-GENTLE' in judge(unknown, CONFIG.verdict).codes
    apart = replace(unknown, misfits={**unknown.misfits, unknown.scenes[0].turn: 3.0})
    assert judge(unknown, CONFIG.verdict).level == 'weak'
    assert judge(apart, CONFIG.verdict).level == 'refused'
    known = gentle(CONFIG.replace({'known.stabiliser': 'no'}))
    assert not known.perhaps_shifted
    assert {'E-ONLY-GENTLE', 'E-LITTLE-YAW', 'E-FLAT-PROFILE'}.isdisjoint(
        judge(known, CONFIG.verdict).codes)
    assert known.sigma[0] < unknown.sigma[0]
    for solution in (unknown, known):
        assert abs(solution.camera.fx - LENS.fx) < 3 * solution.sigma[0]


def test_a_sharp_turn_shows_that_there_is_no_stabiliser():
    solution = gentle(sharp=True)
    assert not solution.perhaps_shifted
    assert 'E-ONLY-GENTLE' not in judge(solution, CONFIG.verdict).codes
