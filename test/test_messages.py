"""docs/troubleshooting.md has every message of the code, and none that there is not."""
from __future__ import annotations

import re
from pathlib import Path

import pytest
from messages import PACKAGE, messages_in

DOCUMENT = Path(__file__).parents[1] / 'docs' / 'troubleshooting.md'
EXPLAINED = ('judge/agreement.py', 'judge/calibration.py', 'judge/conclude.py',
             'judge/mount.py', 'judge/verdict.py', 'judge/witnesses.py',
             'selection.py', 'input', 'detect',
             'reconstruct/scene_file.py', 'turn_store.py', 'workers', 'cli/run.py')
# texts that are no messages: parts of others that are shown with them, SQL, code
PARTS = {
    'judge/calibration.py': {'from one turn alone, which nothing confirms'},
    'judge/conclude.py': {'…, with … times the error of a camera of its own'},
    'judge/agreement.py': {'…: fx to about … %'},
    'judge/witnesses.py': {
        'write rad/s, not degrees a second', 'turns are … ms apart', 'they jump within a turn',
        'they differ by … % of time'},
    'judge/verdict.py': {
        'check its scale, its clock and that it is of this drive, and leave it away if it is '
        'wrong; else drive more turns',
        'the turn… at frame …', '… turn… of earlier drives',
        ', so that nothing confirms the numbers and their sigma'},
    'input/inputs.py': {' (and … more like it)', 'the time of recording'},
    'input/motion.py': {
        'there are more than … of them', '… of … are damaged, doubled or out of order',
        'no car turns at … rad/s; write rad/s, not degrees a second',
        'they are not of one drive'},
    'input/motion_files.py': {'stamp_s and any of …', 'more than … levels or … names'},
    'input/bag_write.py': {
        "repair it first ('ros2 bag convert', 'mcap recover', 'ros2 bag reindex')"},
    'input/bag_read.py': {
        '… does not start like a bag', '… has a broken chunk (…)', 'a packed part is cut off',
        'nothing in it is whole', '… was not closed, and its end is taken from …',
        '… was not closed, and …, which has its end, cannot be used (…)',
        'a part of the bag unpacks to more than … MB',
        'the index does not lead to all messages', 'its rows have more than the file',
        'there is no index', 'its chunks unpack to more than … MB, which is no recording',
        'the index is too large', 'too many chunks overlap', 'there is more than the head says',
        'a record is too large'},
    'input/bag_storage.py': {
        'does not start like a bag|more than|too large|too many',
        'is it a recording? copy it again or record it again',
        '… images; how many are lost is not known',
        '… of … images; … are lost', '… of … images; none is lost',
        "repair it ('mcap recover', 'ros2 bag reindex', 'sqlite3 .recover', 'rosbag reindex'), "
        'copy it again or record it again'},
    'detect/one_camera.py': {'the same view from another mounting', 'the same view … % …'},
    'detect/detection.py': {'they seem to be …', 'they do not rise, or count images'},
    'detect/turn.py': {'the turn at frame …'},
    'reconstruct/scene_file.py': {
        'it is too large when unpacked', 'it is too large',
        'it has format …, this version has …', 'its numbers are no valid scene',
        'it is no file of turns, or one of an older version', '… is not finite, or too large',
        '… is smaller than its header says'},
    'turn_store.py': {'set turns.store to a folder you may write to'},
    'cli/run.py': {
        'written: … with … messages on …', 'rendered and calibrated in … s',
        'no estimate to compare with the truth', 'next: dashcalib run, with the same INPUT',
        'next: record a drive with turns at crossings, in daylight',
        'prominence: how far a turn stands out from the driving before and after it, as a share '
        'of the picture width; frames are counted from 0'},
    'workers/child.py': {'used no processor time for … s'},
    'workers/worker.py': {' in the environment before Python starts'},
    'workers/pool.py': {'…; … is tried again'},
}
NO_MESSAGE = re.compile(r'\s*(SELECT|PRAGMA|import|time timestamp|std_msgs/Header header)\s')
MODULES = sorted(path for name in EXPLAINED for path in
                 ([PACKAGE / name] if name.endswith('.py') else (PACKAGE / name).glob('*.py')))


def document():
    return DOCUMENT.read_text('utf-8')


def entries():
    """Return the beginnings of messages, from the first column of the tables."""
    return re.findall(r'^\| `([^`]+)` \|', document(), re.MULTILINE)


def is_explained(message):
    """Tell whether a message begins like an entry, or is what the document says to do."""
    return any(message.startswith(entry) for entry in entries()) or message in document()


@pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_every_message_is_explained(path):
    name = str(path.relative_to(PACKAGE))
    missing = [text for text in messages_in(path)
               if text not in PARTS.get(name, ()) and not NO_MESSAGE.match(text)
               and not is_explained(text)]
    assert missing == []


def test_what_is_explained_is_in_the_code():
    texts = [text for path in MODULES for text in messages_in(path)]
    assert [entry for entry in entries()
            if not any(text.startswith(entry) for text in texts)] == []


def test_the_exceptions_are_in_the_code():
    for name, parts in PARTS.items():
        assert parts <= set(messages_in(PACKAGE / name)), name


def test_a_message_without_an_entry_would_be_noticed(tmp_path):
    module = tmp_path / 'module.py'
    module.write_text('"""Not this docstring of several words."""\n'
                      'x = f"the wheel number {n} has " f"come off: {why}"\ny = "a few words"\n')
    assert messages_in(module) == ['the wheel number … has come off: …']
    assert not is_explained('the wheel number … has come off: …')
    assert is_explained('only … of at least … turns could be used')
