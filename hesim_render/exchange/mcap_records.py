"""The container of MCAP files, read part by part by means of the package mcap."""

import io
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hesim_render.core.errors import SpecError, how_to_install
from hesim_render.core.guard import reading

#: Most bytes that a compressed part of a file may unpack to. Writers make parts of 1 to 16 MB.
_MOST_CHUNK_BYTES = 1 << 28


def records(path: Path) -> Iterator[Any]:
    """Schemas, channels and messages of a file, from its parts as well."""
    require_mcap(path)
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader

    with reading(path, "as an MCAP file"), path.open("rb") as file:
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=_MOST_CHUNK_BYTES)
        try:
            for record in reader.records:
                if not isinstance(record, Chunk):
                    yield record
                    continue
                stream, size = ReadDataStream(io.BytesIO(_content(record, path))), record.uncompressed_size
                while stream.count < size:
                    opcode, length = stream.read1(), stream.read8()
                    if opcode == Opcode.MESSAGE:
                        yield Message.read(stream, length)
                    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                        yield (Schema if opcode == Opcode.SCHEMA else Channel).read(stream)
                    else:
                        stream.read(length)
        except McapError as error:
            raise SpecError(f"is a damaged MCAP file ({str(error) or type(error).__name__})", file=path) from None


def _content(chunk: Any, path: Path) -> bytes:
    """The content of a part, of the size that it says; a larger one is refused before it is unpacked."""
    most = chunk.uncompressed_size
    if most > _MOST_CHUNK_BYTES:
        raise SpecError(f"has a part of {most} bytes; expected at most {_MOST_CHUNK_BYTES}", file=path)
    if chunk.compression == "zstd":
        import zstandard

        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(most + 1)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise SpecError(f"has parts packed by {chunk.compression[:40]!r}; expected zstd or lz4", file=path)
    if len(data) != most:
        problem = (
            f"has a part that unpacks to {len(data)} bytes{' or more' if len(data) > most else ''}; it says {most}"
        )
        raise SpecError(problem, file=path)
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise SpecError("has a part whose checksum is wrong; the file is damaged", file=path)
    return data


def require_mcap(path: str | Path) -> None:
    """Refuse MCAP files where the package mcap is not installed."""
    try:
        import mcap.writer  # noqa: F401
    except ImportError:
        raise SpecError(f"MCAP files need the package mcap: {how_to_install('ros')}", file=path) from None
