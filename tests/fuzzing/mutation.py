"""Damaged files from sound ones: by bytes, and by the structure that a format has, with checksums
and lengths made good again, so that what is damaged is read at all.

Every draw comes from one generator that is given, so the same number gives the same bytes.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any
from xml.etree import ElementTree

import numpy as np

Rng = np.random.Generator
_TEXT = (".json", ".sur", ".xml", ".xmp", ".csv", ".txt", ".obj", ".mtl", ".usda", ".ply")
# Where headers are, and where most of what a reader decides by stands.
_HEAD = 512
_MOST_BYTES = 1 << 20  # what grows beyond takes time and tells no more
_INTEGERS = (0, 1, -1, 2, 3, 127, 128, 255, 256, 32767, 65535, 65536, 2**31 - 1, -(2**31),
             2**32 - 1, 2**33, 2**62, 2**63 - 1, -(2**63))  # fmt: skip
_FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, float("nan"), float("inf"), -float("inf"), 1e-40, 1e38,
           3.5e38, 1e300, -1e9)  # fmt: skip
# Of stages: what prims, tokens and asset paths may say.
_TYPES = (
    "Mesh", "PointInstancer", "Camera", "Sphere", "Xform", "GeomSubset", "Cube", "Scope", "Nothing",
    "DomeLight", "Material", "BasisCurves", "Points", "Skeleton",
)  # fmt: skip
_TOKENS = (
    "invisible", "inherited", "guide", "proxy", "render", "default", "perspective", "orthographic",
    "Y", "Z", "X", "none", "catmullClark", "leftHanded", "rightHanded", "constant", "uniform",
    "vertex", "varying", "faceVarying", "face", "class", "category", "materialBind", "",
)  # fmt: skip
_ASSETS = (
    "./part.usda", "part.usda", "./root.usda", "./below.usda", "../x.usda", "sub/../../x.usda",
    "/etc/passwd", "file:///etc/passwd", "http://localhost:9/x.usda", "\\\\server\\share.usda",
    "./package.usdz", "./package.usdz[room.usda]", "./layers.usdz[../x.usda]", "none.usda", "",
    "./part.usda:SDF_FORMAT_ARGS:a=b", "`\"./${WHICH}.usda\"`", "`${NO}`", "./plates/one.exr",
    "./one.####.exr", "./é.usda", "anon:0x1", "./part.usda[part.usda]",
)  # fmt: skip
_NUMBER_WORDS = (
    "0", "-0", "1", "-1", "2", "0.5", "nan", "NaN", "inf", "-Infinity", "1e999", "1e308", "-1e308",
    "1e-320", "1e38", "2147483648", "-2147483649", "4294967296", "18446744073709551616", "9" * 400,
    "1e", "0x10", "1_0", "٣", "", "1/2", "1,5", "true",
)  # fmt: skip
_WORDS = (
    "", " ", "../../x", "/etc/passwd", "/dev/zero", "file:///etc/passwd", "http://localhost:9/x",
    "\\\\server\\share", "C:\\x", "a\nb", "\x1b[2J", "\0", "x" * 5000, "%s%n", "{}", "é", "椅子",
    "..", ".", "~", "con", "a/" * 600, "\u202e",
)  # fmt: skip


def mutated(name: str, content: bytes, rng: Rng, others: Sequence[bytes] = ()) -> bytes:
    """A damaged version of a file's content.

    name    of the file, whose ending tells its structure
    others  contents of other files of the kind, to splice in
    """
    suffix = "." + name.rpartition(".")[2].lower()
    structured = _STRUCTURED.get(suffix)
    for _ in range(1 + int(rng.integers(4)) * int(rng.integers(2))):
        draw = rng.random()
        if structured is not None and draw < 0.6:
            try:
                content = structured(content, rng)
                continue
            except Exception:  # damaged already: by bytes then
                pass
        if suffix in _TEXT and draw < 0.85:
            content = _text(content, rng)
        else:
            content = _bytes(content, rng, others)
    return content[:_MOST_BYTES]


# --- Bytes ---------------------------------------------------------------------------------------


def _place(size: int, rng: Rng) -> int:
    """Half of all places are in the head."""
    limit = min(size, _HEAD) if rng.random() < 0.5 else size
    return int(rng.integers(max(limit, 1)))


def _length(size: int, rng: Rng) -> int:
    return int(min(size, 2 ** rng.integers(0, 12)))


def _bytes(content: bytes, rng: Rng, others: Sequence[bytes]) -> bytes:
    data = bytearray(content)
    size, at = len(data), _place(len(data), rng)
    kind = int(rng.integers(10))
    if not size or kind == 0:
        return bytes(data[:at] + rng.bytes(_length(64, rng)) + data[at:])
    if kind == 1:
        data[at] ^= 1 << int(rng.integers(8))
    elif kind == 2:  # as OpenEXR's own fuzzing does: a share of a window
        window = range(at, min(size, at + _length(2048, rng)))
        for place in window:
            if rng.random() < 0.1:
                data[place] = int(rng.integers(256))
    elif kind in (3, 4):
        stored = _stored_number(rng)
        data[at : at + len(stored)] = stored
    elif kind == 5:
        del data[at : at + _length(size, rng)]
    elif kind == 6:
        data = data[:at]
    elif kind == 7:
        again = data[at : at + _length(size, rng)]
        data[at:at] = again * int(rng.integers(1, 4))
    elif kind == 8:
        source = others[int(rng.integers(len(others)))] if others else content
        start = _place(len(source), rng)
        piece = source[start : start + _length(len(source), rng)]
        data[at : at + (len(piece) if rng.random() < 0.5 else 0)] = piece
    else:
        data[at] = int(rng.integers(256))
    return bytes(data)


def _stored_number(rng: Rng) -> bytes:
    order = "<" if rng.random() < 0.7 else ">"
    if rng.random() < 0.3:
        value = _FLOATS[int(rng.integers(len(_FLOATS)))]
        if rng.random() < 0.5:
            return struct.pack(order + "d", value)
        return np.array(np.clip(value, -3e38, 3e38), order + "f4").tobytes()
    number = _INTEGERS[int(rng.integers(len(_INTEGERS)))]
    width = int(rng.choice([1, 2, 4, 8]))
    return (number % (1 << (8 * width))).to_bytes(width, "little" if order == "<" else "big")


# --- Text ----------------------------------------------------------------------------------------


def _text(content: bytes, rng: Rng) -> bytes:
    """Numbers, words and lines; what is no text in it (a binary PLY's body) stays."""
    head, mark, body = content.partition(b"end_header\n")
    text = (head if mark else content).decode("utf-8", "surrogateescape")
    kind = int(rng.integers(6))
    if kind < 3:
        pattern, pool = (
            (r"[-+]?\d[\d.eE+-]*", _NUMBER_WORDS) if kind < 2 else (r"[A-Za-z_/.]+", _WORDS)
        )
        found = list(re.finditer(pattern, text))
        if found:
            match = found[int(rng.integers(len(found)))]
            word = pool[int(rng.integers(len(pool)))]
            if rng.random() < 0.3:
                word = found[int(rng.integers(len(found)))].group()
            text = text[: match.start()] + word + text[match.end() :]
    else:
        lines = text.split("\n")
        at, other = (int(rng.integers(len(lines))) for _ in range(2))
        if kind == 3:
            del lines[at]
        elif kind == 4:
            lines.insert(at, lines[other] * int(rng.choice([1, 1, 1, 300])))
        else:
            lines[at], lines[other] = lines[other], lines[at]
        text = "\n".join(lines)
    return text.encode("utf-8", "surrogateescape") + mark + body


# --- Documents -----------------------------------------------------------------------------------

_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 0.5, 1e-300, 1e300, -1e308, 2**40, 2**62, [], {}, [[]], [None], "",
    "1", {"a": 1}, [1, 2, 3], [[1, 0, 0, 0]] * 4, float("nan"), float("inf"), 10**30,
)  # fmt: skip


def _nodes(node: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Every container with every key of it."""
    keys = list(node) if isinstance(node, dict) else range(len(node)) if type(node) is list else ()
    for key in keys:
        found.append((node, key))
        _nodes(node[key], found)
    return found


def _json(content: bytes, rng: Rng) -> bytes:
    document = json.loads(content)
    places = _nodes(document, [])
    if not places:
        return json.dumps(_VALUES[int(rng.integers(len(_VALUES)))]).encode()
    # Keys of the first levels are few beside thousands of numbers.
    if rng.random() < 0.5:
        places = [p for p in places if isinstance(p[0], dict)] or places
    holder, key = places[int(rng.integers(len(places)))]
    kind = int(rng.integers(8))
    value = holder[key]
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(value, int | float) and not isinstance(value, bool):
        holder[key] = value * float(rng.choice([-1.0, 0.0, 1e-12, 1e12, 0.5, 1e200, 1.0001]))
    elif kind == 2 and isinstance(holder, list):
        holder.insert(int(key), json.loads(json.dumps(value)))
    elif kind == 3:
        source, other = places[int(rng.integers(len(places)))]
        holder[key] = json.loads(json.dumps(source[other]))
    elif kind == 4 and isinstance(value, str):
        holder[key] = _WORDS[int(rng.integers(len(_WORDS)))]
    elif kind == 5:
        for _ in range(int(rng.choice([1, 3, 70]))):
            value = [value]
        holder[key] = value
    else:
        holder[key] = _VALUES[int(rng.integers(len(_VALUES)))]
    return json.dumps(document).encode()


def _xml(content: bytes, rng: Rng) -> bytes:
    root = ElementTree.fromstring(content)
    elements = list(root.iter())
    parents = {child: parent for parent in elements for child in parent}
    element = elements[int(rng.integers(len(elements)))]
    pool = (*_NUMBER_WORDS, *(word for word in _WORDS if word.isprintable()))
    word = pool[int(rng.integers(len(pool)))]
    kind = int(rng.integers(6))
    if kind == 0 and element in parents:
        parents[element].remove(element)
    elif kind == 1 and element in parents:
        parents[element].append(element)
    elif kind == 2 and element.attrib:
        element.set(list(element.attrib)[int(rng.integers(len(element.attrib)))], word)
    elif kind == 3 and element.attrib:
        del element.attrib[list(element.attrib)[int(rng.integers(len(element.attrib)))]]
    elif kind == 4 and (element.text or "").split():
        words = (element.text or "").split()
        words[int(rng.integers(len(words)))] = word
        element.text = " ".join(words)
    else:
        other = elements[int(rng.integers(len(elements)))]
        element.text, element.tail = other.text, other.tail
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _usda(content: bytes, rng: Rng) -> bytes:
    """A word of the kind that stands there in the place of another, or a whole statement gone,
    twice, or in another prim."""
    text = content.decode("utf-8", "surrogateescape")
    pattern, pool = (
        (r"(?<=def )[A-Z]\w+", _TYPES),
        (r'(?<=")\w*(?=")', _TOKENS),
        (r"(?<=@)[^@]*(?=@)", _ASSETS),
        (r"[-+]?\d[\d.eE+-]*", _NUMBER_WORDS),
        (r"\b(true|false)\b", ("true", "false")),
    )[int(rng.integers(5))]
    found = list(re.finditer(pattern, text))
    if found and rng.random() < 0.7:
        match = found[int(rng.integers(len(found)))]
        word = pool[int(rng.integers(len(pool)))]
        return (text[: match.start()] + word + text[match.end() :]).encode(
            "utf-8", "surrogateescape"
        )
    lines = text.split("\n")
    statements = [i for i, line in enumerate(lines) if "=" in line and line.startswith("    ")]
    if not statements:
        return _text(content, rng)
    at, other = (statements[int(rng.integers(len(statements)))] for _ in range(2))
    if rng.random() < 0.5:
        del lines[at]
    elif rng.random() < 0.5:
        lines.insert(other, lines[at])
    else:
        lines[at], lines[other] = lines[other], lines[at]
    return "\n".join(lines).encode("utf-8", "surrogateescape")


# --- Containers with checksums and lengths -------------------------------------------------------


def _png(content: bytes, rng: Rng) -> bytes:
    """One chunk damaged, its CRC right."""
    chunks, at = [], 8
    while at + 12 <= len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    which = int(rng.integers(len(chunks)))
    kind, data = chunks[which]
    if kind == b"IDAT" and rng.random() < 0.5:
        data = zlib.compress(_bytes(zlib.decompress(data), rng, ()))
    else:
        data = _bytes(data, rng, ())
    chunks[which] = kind, data
    if rng.random() < 0.1:
        chunks.insert(int(rng.integers(len(chunks))), chunks[int(rng.integers(len(chunks)))])
    parts = (
        struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks
    )
    return content[:8] + b"".join(parts)


def _glb(content: bytes, rng: Rng) -> bytes:
    """The JSON of a GLB damaged as a document, or its buffer by bytes; lengths are right."""
    chunks, at = [], 12
    while at + 8 <= len(content):
        length, kind = struct.unpack_from("<I4s", content, at)
        chunks.append((kind, content[at + 8 : at + 8 + length]))
        at += 8 + length
    which = int(rng.integers(len(chunks))) if rng.random() < 0.3 else 0
    kind, data = chunks[which]
    data = _json(data, rng) if kind == b"JSON" else _bytes(data, rng, ())
    chunks[which] = kind, data + (b" " if kind == b"JSON" else b"\0") * (-len(data) % 4)
    body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def _npy(content: bytes, rng: Rng) -> bytes:
    """The header of an array as text, with its length right."""
    length = int.from_bytes(content[8:10], "little")
    header = _text(content[10 : 10 + length], rng)
    return content[:8] + struct.pack("<H", len(header) % 65536) + header + content[10 + length :]


def _zip(content: bytes, rng: Rng) -> bytes:
    """One entry damaged in itself, or its name; stored and aligned to 64 bytes, as USD wants it."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = [(item.filename, archive.read(item)) for item in archive.infolist()]
    which = int(rng.integers(len(entries)))
    name, data = entries[which]
    if rng.random() < 0.8:
        data = mutated(name, data, rng)
    else:
        name = _WORDS[int(rng.integers(len(_WORDS)))].replace("\0", "_")[:2000] or "x"
    entries[which] = name, data
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_STORED) as archive:
        for name, data in entries:
            item = zipfile.ZipInfo(name)
            begins = made.tell() + 30 + len(item.filename.encode("utf-8", "surrogateescape"))
            item.extra = (
                b"\x86\x19" + struct.pack("<H", -(begins + 4) % 64) + bytes(-(begins + 4) % 64)
            )
            archive.writestr(item, data)
    return made.getvalue()


@cache
def _crc32c_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return tuple(table)


def _e57(content: bytes, rng: Rng) -> bytes:
    """The pages' payload damaged (its XML as XML half of the times), their checksums right."""
    pages = [content[at : at + 1024] for at in range(0, len(content), 1024)]
    payload = b"".join(page[:1020] for page in pages)
    start = payload.find(b"<?xml")
    end = payload.find(b"</e57Root>") + len(b"</e57Root>")
    if start > 0 and end > start and rng.random() < 0.7:
        document = payload[start:end]
        changed = _number_of_xml(document, rng) if rng.random() < 0.7 else _text(document, rng)
        changed = changed[: end - start].ljust(end - start)
        payload = payload[:start] + changed + payload[end:]
    else:
        payload = _bytes(payload, rng, ())
        payload = payload.ljust(-(-len(payload) // 1020) * 1020, b"\0")
    made, table = b"", _crc32c_table()
    for at in range(0, len(payload), 1020):
        page, value = payload[at : at + 1020], 0xFFFFFFFF
        for byte in page:
            value = table[(value ^ byte) & 255] ^ value >> 8
        made += page + struct.pack(">I", value ^ 0xFFFFFFFF)
    return made


def _number_of_xml(document: bytes, rng: Rng) -> bytes:
    """Another number in one of the elements that hold one, as long as the first."""
    found = list(re.finditer(rb">(-?[\d.]+(?:e[-+]?\d+)?)<", document))
    match = found[int(rng.integers(len(found)))]
    value = repr(_FLOATS[int(rng.integers(len(_FLOATS)))] * float(rng.choice([1, 7, 0.3])))
    width = match.end(1) - match.start(1)
    return (
        document[: match.start(1)] + value.encode()[:width].ljust(width) + document[match.end(1) :]
    )


_STRUCTURED: dict[str, Callable[[bytes, Rng], bytes]] = {
    ".json": _json, ".sur": _json, ".xml": _xml, ".xmp": _xml, ".png": _png, ".glb": _glb,
    ".usda": _usda, ".usdz": _zip, ".npz": _zip, ".npy": _npy, ".e57": _e57,
}  # fmt: skip
