"""A page of two calibrations: where in the picture they differ, and where that can be told."""
from __future__ import annotations

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.report.charts import segments
from dashcalib_ros.report.compare import Comparison
from dashcalib_ros.report.lens_figures import WIDTH, sigma_svg
from dashcalib_ros.report.lens_sections import Drawing
from dashcalib_ros.report.page import template
from dashcalib_ros.report.tables import answers, comparison_rows
from dashcalib_ros.solve.knowledge import SigmaMap

LONGEST = 22.0  # px of the drawing; of an arrow


def difference_html(found: Comparison) -> str:
    """Return the page, complete in itself: both cameras' differences as maps over the picture."""
    head, rows = comparison_rows(found)
    return template('compare.html').render(
        sides=(('A', found.a), ('B', found.b)), answers=[line.plain for line in answers(found)],
        head=head, rows=rows, maps=_maps(found))


def _maps(found: Comparison) -> list[Drawing]:
    whole, size = found.whole, found.b.image_size
    if whole.apart is None:
        return []
    apart, lengths = whole.apart, whole.apart.lengths
    scale = LONGEST / max(float(lengths.max()), 1e-12)
    # every other one: a chessboard of them is dense enough
    arrows = segments(apart.pixels[::2] * WIDTH / size[0], scale * apart.offsets[::2], 'arrow')
    maps = [Drawing('Pixels apart', sigma_svg(SigmaMap(apart.pixels, lengths), size, 1.0,
                                              'pixels apart over the picture', arrows),
                    f'How far A sees a ray from where B sees it, px, the best common rotation '
                    f'removed: {apart.rms:.2f} px over the picture (RMS), {apart.worst:.2f} px at '
                    f'the worst. Arrows: from B to A, {scale * size[0] / WIDTH:.3g} times as long '
                    f'as they are.')]
    sigma = whole.sigma_map
    if sigma is None:
        return maps
    maps.append(Drawing('Sigma of the difference', sigma_svg(sigma, size, 1.0),
                        'How far they may be apart by chance, px, one sigma of all that the '
                        'files know.'))
    at = {tuple(pixel): value for pixel, value in zip(sigma.pixels.tolist(), sigma.sigma,
                                                       strict=True)}
    ratio: Floats = np.array([length / at.get(tuple(pixel), np.nan) for pixel, length in zip(
        apart.pixels.tolist(), lengths, strict=True)])
    known = np.isfinite(ratio)
    return [*maps, Drawing(
        'In sigmas', sigma_svg(SigmaMap(apart.pixels[known], ratio[known]), size, 1.0,
                               'sigmas apart over the picture'),
        'The first map divided by the second: where it is well above 1, the difference is more '
        'than chance.')]
