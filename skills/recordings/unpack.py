"""Unpack a chunk, and no more than it claims."""

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from skills.errors import UnreadableRecording
from skills.recordings.source import RECOVER


def unpack(stored: memoryview, compression: str, size: int) -> bytes:
    """Unpack a chunk into exactly the size it claims and never more; a frame's own size may be any.

    Raises:
        UnreadableRecording: It comes to another size, something follows it, it is damaged, or packed in another way.
    """
    try:
        if compression == "zstd":
            data = _unpack_zstd(stored, size)
        elif compression == "lz4":
            data = _unpack_lz4(stored, size)
        elif compression == "":
            data = bytes(stored)
        else:
            raise UnreadableRecording(f"A chunk is compressed with {compression!r}; zstd, lz4 and none are read.")
    except (zstandard.ZstdError, RuntimeError) as error:
        raise UnreadableRecording(f"A chunk does not unpack to the {size} bytes that it claims. {RECOVER}") from error
    if len(data) != size:
        raise UnreadableRecording(f"A chunk does not unpack to the {size} bytes that it claims. {RECOVER}", bytes=size)
    return data


def _unpack_zstd(stored: memoryview, size: int) -> bytes:
    frame = zstandard.get_frame_parameters(stored)
    if frame.content_size not in (size, zstandard.CONTENTSIZE_UNKNOWN):
        raise zstandard.ZstdError("the frame says another size")
    return zstandard.ZstdDecompressor().decompress(stored, max_output_size=size, allow_extra_data=False)


def _unpack_lz4(stored: memoryview, size: int) -> bytes:
    unpacker = lz4.frame.LZ4FrameDecompressor()
    data: bytes = unpacker.decompress(stored, max_length=size + 1)
    if not unpacker.eof or unpacker.unused_data:
        raise RuntimeError("the frame does not end where the chunk does")
    return data
