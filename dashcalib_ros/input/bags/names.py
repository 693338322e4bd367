"""What the files of a bag are called."""
from __future__ import annotations

SUFFIXES = ('.mcap', '.db3', '.bag')
METADATA = 'metadata.yaml'


def is_bag_file(name: str) -> bool:
    """Tell whether this is the name of a bag's storage file, compressed or not."""
    return name.lower().removesuffix('.zstd').removesuffix('.active').endswith(SUFFIXES)
