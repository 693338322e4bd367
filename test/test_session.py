# SPDX-License-Identifier: Apache-2.0
"""Command and Python are one wiring: the same drive gives the same numbers in both."""
from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import yaml
from shared_drive import ONE_TURN, QUICK, SPEC

from dashcalib_ros import Calibration, calibrate, check, load_camera
from dashcalib_ros.cli import main

RATE_HZ = 50.0


@pytest.fixture(scope='module')
def folder(shared_drive, tmp_path_factory):
    """Write a drive of one turn, its gyro and the settings into a folder."""
    folder, drive = tmp_path_factory.mktemp('session'), shared_drive
    (folder / 'drive').mkdir()
    for frame in list(drive.frames())[:ONE_TURN]:
        cv2.imwrite(str(folder / 'drive' / f'{frame.index:04}.png'), frame.image)
    stamps_s = np.array([drive.stamp_ns(n) - drive.stamp_ns(0) for n in range(ONE_TURN)]) / 1e9
    seconds = np.arange(0.0, stamps_s[-1], 1 / RATE_HZ)
    rates = np.gradient(np.interp(seconds, stamps_s, drive.yaw[:ONE_TURN]), seconds)
    lines = [f'{at:.3f},0,0,{rate:.6f}' for at, rate in zip(seconds, rates, strict=True)]
    (folder / 'gyro.csv').write_text('\n'.join(['stamp_s,gyro_x,gyro_y,gyro_z', *lines]))
    (folder / 'warm.csv').write_text('stamp_s,temperature\n0,20\n100,120\n')
    changed = {name: value for name, value in QUICK.flat().items()
               if value != type(QUICK)().flat()[name]}
    (folder / 'config.yaml').write_text(yaml.safe_dump(changed))
    return folder


@pytest.fixture(scope='module')
def command(folder):
    """Return the result.json of the command."""
    main(['run', str(folder / 'drive'), '--fps', str(SPEC.rate), '--quiet',
          '--motion', str(folder / 'gyro.csv'), '--config', str(folder / 'config.yaml'),
          '--temperature', str(folder / 'warm.csv'), '--out', str(folder / 'out')])
    return json.loads((folder / 'out' / 'result.json').read_text())


def test_command_and_python_give_the_same_numbers(folder, command, tmp_path):
    found = calibrate(folder / 'drive', fps=SPEC.rate, config=QUICK, motion=folder / 'gyro.csv',
                      temperature=str(folder / 'warm.csv'))
    found.save(tmp_path)
    python = json.loads((tmp_path / 'result.json').read_text())
    # the gyro counts in both
    assert python['witnesses']['gyro'] is not None
    # it rises by 1 K each second
    [turn] = [turn for turn in python['turns'] if turn['used']]
    assert abs(python['temperature_c'] - 20 - (turn['stamp'] - found.start_s)) < 1
    command.pop('timing'), python.pop('timing')
    assert python == command


@pytest.mark.thorough
def test_check_of_the_command_and_of_python_say_the_same(folder, command, capsys):
    out = folder / 'out' / 'result.json'
    main(['check', str(out), str(folder / 'drive'), '--fps', str(SPEC.rate), '--quiet', '--json',
          '--motion', str(folder / 'gyro.csv'), '--config', str(folder / 'config.yaml')])
    said = json.loads(capsys.readouterr().out)
    found = check(load_camera(out).camera, folder / 'drive', fps=SPEC.rate, config=QUICK,
                  motion=folder / 'gyro.csv')
    assert (found.answer, list(found.reasons)) == (said['answer'], said['reasons'])


@pytest.mark.thorough
def test_a_part_of_the_pictures_is_a_camera_of_its_own(folder, command, tmp_path, capsys):
    """Two cameras side by side, of which the left one is calibrated."""
    (tmp_path / 'both').mkdir()
    for path in (folder / 'drive').iterdir():
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        other = np.full((image.shape[0] + 6, image.shape[1] + 30), 90, np.uint8)
        other[4:-2, 10:-20] = image
        cv2.imwrite(str(tmp_path / 'both' / path.name), other)
    height, width = image.shape
    arguments = ['--fps', str(SPEC.rate), '--quiet', '--motion', str(folder / 'gyro.csv'),
                 '--config', str(folder / 'config.yaml'), '--crop', f'10,4,{width},{height}']
    main(['run', str(tmp_path / 'both'), *arguments, '--out', str(tmp_path / 'out')])
    result = json.loads((tmp_path / 'out' / 'result.json').read_text())
    assert result['part'] == [10, 4, width, height] and result['image_size'] == [width, height]
    assert 'E-PICTURE-PART' in result['warning_codes']
    assert command['part'] is None and 'E-PICTURE-PART' not in command['warning_codes']
    for key in ('intrinsics', 'sigma', 'turns', 'verdict'):
        assert result[key] == command[key]
    assert Calibration.load(tmp_path / 'out').part == (10, 4, width, height)
    [file] = (tmp_path / 'out').glob('calibration*.yaml')
    assert yaml.safe_load(file.read_text().partition('---')[2])['dashcalib']['part'] == [
        10, 4, width, height]
    capsys.readouterr()
    assert main(['run', str(tmp_path / 'both'), '--crop', f'40,0,{width},{height}',
                 '--out', str(tmp_path / 'none')]) == 2
    assert 'E-CROP-OUTSIDE' in capsys.readouterr().err
