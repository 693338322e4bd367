# SPDX-License-Identifier: Apache-2.0
"""All clips of one camera -> its own result.

A clip that shows another camera (another device, a zoom, another mode of the sensor) is named and
left out; it is never averaged.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend, Lines
from dashcalib_ros.detect.bend import GROUP_S
from dashcalib_ros.detect.straights import StraightCollector
from dashcalib_ros.detect.turn import TurnId, is_turn
from dashcalib_ros.errors import Notice, counted, spared
from dashcalib_ros.fleet.solved import ClipShare, Estimate, Solved
from dashcalib_ros.input.source import size_text
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.agreement import focal_of, sigma_of, turns_of_another_camera
from dashcalib_ros.judge.conclude import Evidence, conclude, straight_lines
from dashcalib_ros.judge.verdict import Grounds, lacks_knowledge_only, only_gentle
from dashcalib_ros.reconstruct.repeated import without_repeated
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.robust import weighted_median
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.store.scene_file import MOST_LINES, Origin, SceneFile, StoredTurn

Clips = Mapping[str, SceneFile]


@dataclass(frozen=True)
class ClipTurn:
    """A turn of one of the clips. stored: with an identity that is unique in the camera."""

    clip: str
    stored: StoredTurn


# maximum number of solutions; each leaves out the clips that contradict the one before
ROUNDS = 3


def fuse(camera: str, camera_model: str, clips: Clips, config: Config) -> Solved:
    """Calibrate one camera from all its clips, by name; their order does not count.

    As in one drive, other stretches than turns are used where turns are few or leave it weak.
    """
    turns = {name: replace(clip, turns=tuple(
        turn for turn in clip.turns if is_turn(turn.prominence))) for name, clip in clips.items()}
    count, everything = (sum(len(clip.turns) for clip in some.values())
                         for some in (turns, clips))
    if not config.turns.thorough and config.turns.wanted <= count < everything:
        found = _fused(camera, camera_model, turns, config)
        if found.calibration.verdict.level != 'weak':
            return found
    return _fused(camera, camera_model, clips, config)


def _fused(camera: str, camera_model: str, clips: Clips, config: Config) -> Solved:
    clips = dict(sorted(clips.items()))
    left_out = _same_content(clips)
    left_out.update(_other_origins(_without(clips, left_out)))
    kept = _without(clips, left_out)
    # all clips that are kept are alike
    origin = next((clip.origin for clip in kept.values()), Origin((0, 0)))
    turns = _numbered(kept)
    solution: Solution | None = None
    for further in reversed(range(ROUNDS)):
        scenes, repeated = _chosen(turns, left_out, config)
        solution = solve(scenes, config) if scenes else None
        own = shares_of(solution, turns, origin.scale.px)
        of_another = contradicting(solution, turns, own)
        if not (of_another and further):
            break
        left_out.update(of_another)
    kept = _without(clips, left_out)
    evidence = _evidence(kept, origin, [turns[scene.turn].stored for scene in scenes], left_out)
    lines = spared('the check of straight lines', [], straight_lines, solution, evidence)
    calibration = replace(conclude(solution, evidence, config), input_name=camera)
    if solution is None:
        why = _nothing_found(kept)
        calibration = replace(calibration, verdict=Verdict('refused', (why,)))
    shares = dict.fromkeys(clips, ClipShare())
    shares.update({turns[turn].clip: ClipShare.without(
        Notice('E-CLIP-REPEATED', f'shows the same pictures as {turns[other].clip}'))
        for turn, other in sorted(repeated.items(), reverse=True)})
    shares.update(own)
    shares.update({name: ClipShare.without(why) for name, why in left_out.items()})
    return Solved(camera, camera_model, calibration,
                  _estimate(solution, origin, config, lines), shares)


def _without(clips: Clips, left_out: Mapping[str, Notice]) -> Clips:
    return {name: clip for name, clip in clips.items() if name not in left_out}


def _estimate(solution: Solution | None, origin: Origin, config: Config, lines: Bend | None
              ) -> Estimate | None:
    """Return the camera in px of the input, also where it is refused; None without a solution."""
    if solution is None:
        return None
    px = origin.scale.px
    units = np.outer(solution.camera.units(px), solution.camera.units(px))
    return Estimate(
        solution.camera.resized(px, origin.image_size), solution.covariance * units,
        solution.carried(solution.posterior.alike.covariance) * units,
        solution.picture.times(px),
        solution.reprojection_error_px * px,
        # other units must not learn from what a stabiliser could have made
        lacks_knowledge_only(Grounds(solution, config.verdict, lines))
        and not only_gentle(solution))


def _same_content(clips: Clips) -> dict[str, Notice]:
    first: dict[str, str] = {}
    return {name: Notice('E-CLIP-REPEATED', f'has the same content as {first[clip.content]}')
            for name, clip in clips.items()
            if first.setdefault(clip.content, name) != name}


def _other_origins(clips: Clips) -> dict[str, Notice]:
    """Return the clips of another image size than most, or that were resized differently."""
    def weight(origin: Origin) -> tuple[int, int, int, str]:
        turns = [len(clip.turns) for clip in clips.values() if clip.origin == origin]
        # clips count before turns: one clip with many does not decide
        return sum(map(bool, turns)), sum(turns), len(turns), str(origin)

    main = max({clip.origin for clip in clips.values()}, key=weight, default=Origin((0, 0)))
    return {name: Notice('E-CLIP-OTHER-SIZE', f'is {size_text(clip.origin.image_size)}, and most '
                         f'clips of this camera are {size_text(main.image_size)}')
            if clip.origin.image_size != main.image_size else
            Notice('E-CLIP-OTHER-SETTINGS', 'was gathered with another max_width or min_width '
                   'than most clips of this camera')
            for name, clip in clips.items() if clip.origin != main}


def _numbered(clips: Clips) -> dict[TurnId, ClipTurn]:
    found: dict[TurnId, ClipTurn] = {}
    for name, clip in clips.items():
        for turn in clip.turns:
            key = TurnId.stored(len(found), name)
            found[key] = ClipTurn(name, replace(turn, scene=replace(turn.scene, turn=key)))
    return found


def _chosen(turns: Mapping[TurnId, ClipTurn], left_out: Mapping[str, Notice], config: Config
            ) -> tuple[list[Scene], dict[TurnId, TurnId]]:
    """Return the scenes to use, and which turns repeat others.

    Each clip's best turn first, then each clip's second, and so on, so that every clip has a say,
    also about whether it is of this camera; then other stretches, likewise.
    """
    by_clip: dict[str, list[TurnId]] = {}
    for key in sorted(turns, key=lambda key: (-turns[key].stored.prominence, key)):
        if turns[key].clip not in left_out:
            by_clip.setdefault(turns[key].clip, []).append(key)
    # no stretch takes the place of a turn
    ranked = [key for *_, key in sorted(
        (not is_turn(turns[key].stored.prominence), place, -turns[key].stored.prominence, key)
        for keys in by_clip.values() for place, key in enumerate(keys))]
    repeated: dict[TurnId, TurnId] = {}
    while True:
        best = [key for key in ranked if key not in repeated][:config.fleet.turns]
        scenes, more = without_repeated([turns[key].stored.scene for key in best])
        if not more:
            return scenes, repeated
        repeated.update(more)


def _evidence(clips: Clips, origin: Origin, stored: Sequence[StoredTurn],
              left_out: Mapping[str, Notice]) -> Evidence:
    return Evidence(
        image_size=origin.image_size, scale=origin.scale,
        frames=sum(clip.frames for clip in clips.values()), stored=tuple(stored),
        warnings=tuple(Notice('E-CLIP-LEFT-OUT', f'the clip {name} was left out: it {why}')
                       for name, why in sorted(left_out.items())),
        turns=(), built={}, magnitudes=np.zeros((0, 2)), mask=None, timing={},
        lines=_lines_of(clips),
        straights=StraightCollector().straights())  # none: the turns' paths stand in


def _lines_of(clips: Clips) -> Lines | None:
    """Return the upright lines of all clips, as of one drive through one clip after the other."""
    found = [clip.lines for clip in clips.values() if clip.lines is not None and len(clip.lines)]
    if not found:
        return None
    stamps = [found[0].stamps_s]
    for lines in found[1:]:
        # clips may count from 0 each, but what is apart in time is apart in place, too
        stamps.append(lines.stamps_s - lines.stamps_s[0] + stamps[-1][-1] + 2 * GROUP_S)
    whole = Lines(np.concatenate([lines.points for lines in found]), np.concatenate(stamps))
    return whole.chosen(np.arange(len(whole)) % -(-len(whole) // MOST_LINES) == 0)


def _nothing_found(clips: Clips) -> Notice:
    if not clips:
        return Notice('E-NO-CLIP', 'none of its clips could be read')
    turns = sum(clip.found for clip in clips.values())
    scenes = sum(len(clip.turns) for clip in clips.values())
    what = counted(len(clips), 'clip')
    if not turns:
        return Notice('E-NO-TURN', f'no turn was found in {what}; add clips in which the car '
                                   f'turns at crossings')
    if not scenes:
        return Notice('E-NO-SCENE', f'none of the {turns} turns in {what} could be reconstructed')
    return Notice('E-NO-COMMON-CAMERA',
                  f'no common camera explains the {counted(scenes, "turn")} of {what}')


def contradicting(solution: Solution | None, turns: Mapping[TurnId, ClipTurn],
                  shares: Mapping[str, ClipShare]) -> dict[str, Notice]:
    """Return the clips, less than half of all, that are of another camera, and why.

    Two things show it: the cost of a clip's turns, and the fx of these turns alone.
    """
    if solution is None:
        return {}
    of_another = turns_of_another_camera(solution.misfits)
    used = Counter(turns[key].clip for key in solution.misfits)
    against = Counter(turns[key].clip for key in of_another)
    found = {clip: Notice('E-CLIP-OTHER-CAMERA', f'shows another camera: the cost of its turns is '
                          f'{worst:.1f} times as high with this camera as with one of their own')
             for clip, count in sorted(against.items()) if 2 * count >= used[clip]
             for worst in [max(solution.misfits[key] for key in of_another
                               if turns[key].clip == clip)]}
    found.update(_other_focal(shares))
    # where half of them differ, nobody knows which are right: the verdict is weak, and says so
    return found if 2 * len(found) < len(used) else {}


# a clip whose own fx is farther off that of most, in sigmas and in shares of it, is of another
# camera; on one real drive gentle bends differ by 3 % from the sharp turn
OTHER_FOCAL, OTHER_FOCAL_SHARE = 4.0, 0.05


def _other_focal(shares: Mapping[str, ClipShare]) -> dict[str, Notice]:
    known = [(clip, share.fx, share.fx_sigma) for clip, share in sorted(shares.items())
             if share.fx and share.fx_sigma]
    if len(known) < 3:
        return {}
    fx, sigma = (np.array([each[place] for each in known], float) for place in (1, 2))
    tolerance = OTHER_FOCAL_SHARE * fx
    middle = weighted_median(fx, 1 / (sigma**2 + tolerance**2))
    limit = np.maximum(tolerance, OTHER_FOCAL * sigma)
    return {known[n][0]: Notice('E-CLIP-OTHER-CAMERA', f'shows another camera: fx from its turns '
                                f'alone is {fx[n]:.0f} px, and {middle:.0f} px from most clips')
            for n in np.flatnonzero(np.abs(fx - middle) > limit)}


def shares_of(solution: Solution | None, turns: Mapping[TurnId, ClipTurn], px: float
            ) -> dict[str, ClipShare]:
    """Return what each clip gave, and the fx of its turns alone."""
    if solution is None:
        return {}
    found: dict[str, ClipShare] = {}
    clips = {turns[scene.turn].clip for scene in solution.scenes}
    so_far: list[int] = []
    for clip in sorted(clips):
        own = [n for n, scene in enumerate(solution.scenes) if turns[scene.turn].clip == clip]
        focal, so_far = focal_of(solution, own), [*so_far, *own]
        found[clip] = ClipShare(used=len(own), fx=px * focal.fx, fx_sigma=px * focal.sigma,
                                sigma_so_far=px * sigma_of(solution, so_far))
    return found
