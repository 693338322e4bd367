"""A difference in words."""
from __future__ import annotations

from dashcalib_ros.arrays import Floats
from dashcalib_ros.judge.difference import (
    ALLOWED_CENTRE_PX,
    ALLOWED_FOCAL,
    RELEVANT,
    Difference,
)

# of the width; a centre that is farther off looks like that of a part of the picture
CROPPED = 0.04


def answers_of(found: Difference, whose: str) -> tuple[str, ...]:
    """Return what a difference says: how far, whether it can be told, whether it matters.

    whose: the sigma is.
    """
    far = ('apart: unknown, a lens model is blind in parts of the picture' if found.apart is None
           else f'apart: {found.apart.rms:.2f} px over the picture, {found.apart.worst:.2f} px at '
                f'the worst, best rotation removed')
    sigma = None if found.sigma_px is None else found.sigma_px.rms
    told = ('unknown, neither file has a covariance: give a result.json of dashcalib run'
            if sigma is None or found.told_apart is None else
            f'{"yes" if found.told_apart else "no, chance explains it"}; the sigma of {whose} is '
            f'{sigma:.2f} px')
    return (far, f'told apart: {told}', f'matters: {_matters(found)}')


def _matters(found: Difference) -> str:
    limit = f'{found.relevant_px:.1f} px, as of a focal length {100 * RELEVANT:.0f} % off'
    if found.matters:
        return (f'yes, good calibrations of one lens differ by less: '
                f'{100 * ALLOWED_FOCAL:.1f} % of the focal length ({found.allowed_px:.1f} px over '
                f'the picture), {ALLOWED_CENTRE_PX:.0f} px of the centre')
    if found.sigma_px is None:
        return (f'no, good calibrations of one lens differ by up to {found.allowed_px:.1f} px, as '
                f'of a focal length {100 * ALLOWED_FOCAL:.1f} % off')
    if found.matters is None and found.bound_px <= found.relevant_px:
        return ('cannot be told: good calibrations of one lens hardly differ as much, but chance '
                'may explain the rest')
    if found.matters is None:
        return f'cannot be told: an error of {limit}, may be there'
    return f'no, with 95 % it is below {found.bound_px:.1f} px; the limit is {limit}'


def reasons_of(found: Difference) -> tuple[str, ...]:
    """Return in words what the difference from a drive's own camera says."""
    parts = ([_PARTS[way](found, offsets) for way, offsets in found.ways().items()]
             if found.matters else [])
    return (*answers_of(found, 'the drive'), *(text for text in parts if text))


def _focal(found: Difference, offsets: Floats) -> str:
    shares = offsets / [found.found.fx, found.found.fy]
    if max(abs(shares)) == 0:
        return ''
    if abs(shares[0] - shares[1]) < 0.5 * max(abs(shares)):
        share = float(shares.mean())
        return (f'focal length: {100 * abs(share):.1f} % too {"long" if share > 0 else "short"}')
    names = [f'{name} {100 * abs(share):.1f} % too {"long" if share > 0 else "short"}'
             for name, share in zip(('fx', 'fy'), shares, strict=True)
             if abs(share) > 0.25 * max(abs(shares))]
    return f'focal length: {", ".join(names)}'


def _centre(found: Difference, offsets: Floats) -> str:
    x, y = offsets
    sides = [f'{abs(value):.1f} px too far {way[int(value > 0)]}'
             for value, way in ((x, ('left', 'right')), (y, ('up', 'down')))
             if abs(value) > 0.25 * max(abs(x), abs(y))]
    text = f'centre: {" and ".join(sides)}'
    if max(abs(x), abs(y)) > CROPPED * found.given.image_size[0]:
        text += ': is the calibration for another part of the picture?'
    return text


def _distortion(found: Difference, offsets: Floats) -> str:
    names = found.found.names()[4:]
    values = [f'{name} {value:+.3f}' for name, value in zip(names, offsets, strict=True)]
    return f'distortion: off by {", ".join(values)}'


_PARTS = {'focal length': _focal, 'centre': _centre, 'distortion': _distortion}
