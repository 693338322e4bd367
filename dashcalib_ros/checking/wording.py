"""A difference in words."""
from __future__ import annotations

from dashcalib_ros.arrays import Floats
from dashcalib_ros.checking.difference import Difference

# of the width; a centre that is farther off looks like that of a part of the picture
CROPPED = 0.04


def reasons_of(found: Difference) -> tuple[str, ...]:
    """Return in words what the difference says."""
    apart = ('blind in parts of the picture' if found.rms_px is None else
             f'{found.rms_px:.1f} px off over the picture ({found.worst_px:.1f} px where it is '
             f'worst)')
    if found.significant:
        parts = [_PARTS[way](found, offsets) for way, offsets in found.ways().items()]
        return (f'it is {apart}, {found.distance:.0f} sigmas, where chance explains '
                f'{found.limit:.1f}',
                *(text for text in parts if text))
    if found.bound_px is not None and found.bound_px <= found.relevant_px:
        return (f'it is {apart}, as chance explains ({found.distance:.1f} sigmas); with 95 % it '
                f'is right to {found.bound_px:.1f} px',)
    return (f'it is {apart}, as chance explains ({found.distance:.1f} sigmas), but the drive '
            f'itself knows its camera only to {found.sigma_px.rms:.1f} px (sigma): an error of '
            f'{found.relevant_px:.1f} px, as of a focal length 2 % off, may be there',)


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
