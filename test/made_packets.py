# SPDX-License-Identifier: Apache-2.0
"""The packets of a video, as publishers of messages make them."""
from __future__ import annotations

from fractions import Fraction

import av
import numpy as np

SIZE = (64, 48)


def levels(count=20):
    """Return pictures that tell their number: each of another brightness."""
    return [np.full(SIZE[::-1], 40 + 8 * n, np.uint8) for n in range(count)]


def encoded(pictures, codec='libx264', key_every=8, **options):
    """Return a packet of each picture, as a publisher of a video makes them."""
    context = av.CodecContext.create(codec, 'w')
    context.width, context.height, context.pix_fmt = *SIZE, 'yuv420p'
    context.time_base, context.gop_size = Fraction(1, 10), key_every
    context.options = options or {'tune': 'zerolatency', 'x265-params': 'log-level=none'}
    packets = []
    for n, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(np.repeat(picture[..., None], 3, 2), 'bgr24')
        frame.pts = n
        packets += context.encode(frame)
    packets += context.encode(None)
    # of H.264 with pictures between others: in the order in which they are decoded
    return [(packet.pts, bytes(packet)) for packet in packets]
