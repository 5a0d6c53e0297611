"""Records of MCAPs, taken apart and put together as their specification (mcap.dev) has them."""

import struct


def read_records(data: bytes) -> list[tuple[int, bytes]]:
    """The records of an MCAP without its magic, or of a chunk, by operation code; what is cut off is short."""
    records, position = [], 0
    while position + 9 <= len(data):
        op, size = struct.unpack_from("<BQ", data, position)
        records.append((op, data[position + 9 : position + 9 + size]))
        position += 9 + size
    return records


def pack_records(records: list[tuple[int, bytes]]) -> bytes:
    """The records with their lengths."""
    return b"".join(struct.pack("<BQ", op, len(content)) + content for op, content in records)
