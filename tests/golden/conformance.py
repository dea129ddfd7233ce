"""Makes the MCAP conformance suite's files again from their descriptions, and checks them.

    git clone https://github.com/foxglove/mcap && python3 tests/golden/conformance.py mcap OUT
    TCVAE_FOREIGN_BAGS=OUT cargo test --lib foreign

A clone without git-lfs has, for each file, its records as JSON and a pointer with its SHA-256. The bytes are
made from the records, and written only if their digest is the pointer's. With git-lfs this is not needed:
TCVAE_FOREIGN_BAGS can name the clone's tests/conformance/data. Needs Python's standard library alone.
"""

import hashlib
import json
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

MAGIC = b"\x89MCAP0\r\n"
OPCODES = {
    "Header": 1, "Footer": 2, "Schema": 3, "Channel": 4, "Message": 5, "Chunk": 6, "MessageIndex": 7,
    "ChunkIndex": 8, "Attachment": 9, "AttachmentIndex": 10, "Statistics": 11, "Metadata": 12,
    "MetadataIndex": 13, "SummaryOffset": 14, "DataEnd": 15,
}
# The fields of each record in the order of the format, with what they are: a struct code for a number;
# s string, m map of strings, t map of u16 to u64, b bytes with a length of four bytes (B: of eight; r: none).
LAYOUT = {
    "Header": "profile:s library:s",
    "Footer": "summary_start:Q summary_offset_start:Q summary_crc:I",
    "Schema": "id:H name:s encoding:s data:b",
    "Channel": "id:H schema_id:H topic:s message_encoding:s metadata:m",
    "Message": "channel_id:H sequence:I log_time:Q publish_time:Q data:r",
    "ChunkIndex": "message_start_time:Q message_end_time:Q chunk_start_offset:Q chunk_length:Q "
                  "message_index_offsets:t message_index_length:Q compression:s compressed_size:Q "
                  "uncompressed_size:Q",
    "Attachment": "log_time:Q create_time:Q name:s media_type:s data:B",
    "AttachmentIndex": "offset:Q length:Q log_time:Q create_time:Q data_size:Q name:s media_type:s",
    "Statistics": "message_count:Q schema_count:H channel_count:I attachment_count:I metadata_count:I "
                  "chunk_count:I message_start_time:Q message_end_time:Q channel_message_counts:t",
    "Metadata": "name:s metadata:m",
    "MetadataIndex": "offset:Q length:Q name:s",
    "SummaryOffset": "group_opcode:B group_start:Q group_length:Q",
    "DataEnd": "data_section_crc:I",
}

# What is behind these records' fields would be a part of them, or their length is fixed.
NOT_PADDED = ["Message", "DataEnd", "Footer"]


def number(code, value):
    return struct.pack("<" + code, int(value))


def text(value):
    return number("I", len(value.encode())) + value.encode()


def map_of(pairs):
    packed = b"".join(pairs)
    return number("I", len(packed)) + packed


def field(record, name, kind, value):
    if kind == "s":
        return text(value)
    if kind == "m":
        return map_of(text(k) + text(v) for k, v in value.items())
    if kind == "t":
        return map_of(number("H", k) + number("Q", v) for k, v in value.items())
    if name == "data":
        data = bytes(map(int, value))
        return {"b": number("I", len(data)), "B": number("Q", len(data)), "r": b""}[kind] + data
    return number(kind, value)


def framed(kind, content):
    return bytes([OPCODES[kind]]) + number("Q", len(content)) + content


def packed(record, padding=b""):
    """A record, with the bytes behind its fields that readers must pass over."""
    kind, fields = record["type"], dict(record["fields"])
    layout = (f.split(":") for f in LAYOUT[kind].split())
    content = b"".join(field(record, name, code, fields[name]) for name, code in layout)
    if kind == "Attachment":
        content += number("I", zlib.crc32(content))
    return framed(kind, content if kind in NOT_PADDED else content + padding)


def chunked(records, features, padding, start):
    """The records in one chunk, and the index of each channel's messages behind it."""
    inside, index = b"", {}
    for record in records:
        fields = dict(record["fields"])
        if record["type"] == "Channel":
            index[fields["id"]] = []
        if record["type"] == "Message":
            index[fields["channel_id"]].append((fields["log_time"], len(inside)))
        inside += packed(record)
    times = [int(time) for messages in index.values() for time, _ in messages] or [0]
    head = number("Q", min(times)) + number("Q", max(times)) + number("Q", len(inside))
    head += number("I", zlib.crc32(inside)) + text("") + number("Q", len(inside))
    out = framed("Chunk", head + inside)
    if "mx" in features:
        for channel, messages in index.items():
            entries = map_of(number("Q", time) + number("Q", offset) for time, offset in messages)
            if messages:
                out += framed("MessageIndex", number("H", channel) + entries + padding)
    return out


def file_of(description):
    features = description["meta"]["variant"]["features"]
    padding = b"\x01\xff\xff" if "pad" in features else b""
    header, *records, footer = description["records"]
    end = next(i for i, record in enumerate(records) if record["type"] == "DataEnd")
    out = MAGIC + packed(header, padding)
    data = records[:end]
    if "ch" in features:
        out += chunked(data, features, padding, len(out))
    else:
        out += b"".join(packed(record, padding) for record in data)
    out += b"".join(packed(record, padding) for record in records[end:])
    return out + packed(footer, padding) + MAGIC


def main(checkout, output):
    def git(*arguments):
        return subprocess.run(["git", "-C", checkout, *arguments], check=True, capture_output=True).stdout

    names = git("ls-tree", "-r", "--name-only", "HEAD", "tests/conformance/data").decode().split()
    made, wrong = 0, []
    for name in (n for n in names if n.endswith(".json")):
        described = git("show", f"HEAD:{name}")
        content = file_of(json.loads(described))
        pointer = git("show", f"HEAD:{name.removesuffix('.json')}.mcap").decode(errors="replace")
        digest = re.search(r"oid sha256:([0-9a-f]{64})", pointer)
        if digest is None or hashlib.sha256(content).hexdigest() != digest[1]:
            wrong.append(name)
            continue
        path = output / Path(name).relative_to("tests/conformance/data")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(described)
        path.with_suffix(".mcap").write_bytes(content)
        made += 1
    print(f"{made} files whose digest is the pointer's, {len(wrong)} others", *wrong[:10], sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))
