"""Damage to files: bytes, pieces, lines, numbers and words, chosen by a random generator."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from random import Random

from tests.fuzz.contract import Reader

MAX_SIZE = 50_000
"""In bytes; larger ones tell nothing that smaller ones do not."""

NUMBER = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9.]*")

NUMBERS = (b"0", b"-0", b"-1", b"1", b"2", b"1e308", b"-1e308", b"1e309", b"1e-400", b"nan", b"NaN",
           b"inf", b"-inf", b"0x10", b"1_000", b"1,5", b"1d3", b"", b" ", b"2147483648",
           b"-2147483649", b"9223372036854775808", b"1e18", b"0.1", b"1" * 400, b"9" * 5000,
           b"\xd9\xa1\xd9\xa2", "½".encode(), b"1e", b"--1", b"1.2.3", b"true", b"1979-05-27",
           b"[]", b"{}", b'"a"', b"[1, 2]", b"1e5", b"10000000")
PIECES = (b"\0", b"\r", b"\n", b"\r\n", b"\t", b",", b";", b'"', b'"""', b"'", b"#", b"%", b"!",
          b"[", b"]", b"{", b"}", b"=", b":", b"\xff", b"\xef\xbb\xbf", b"\xff\xfe", b"\x1b[31m",
          "\u2028".encode(), "\u202e".encode(), b"\xed\xa0\x80", b"\\", b"..", b"/etc/passwd",
          b"<< 7*7 >>", b"{{ 7*7 }}", b"<script>", b"$\\frac$", b"}; ", b"\\u001b", b"//", b"/*",
          b"\x0b", b"\x0c", b"\x1c", b"\x85", "\x85".encode(), b"[" * 3000, b"a" * 2000, b"," * 500)
INTEGERS = (0, 1, 2, 3, 7, 8, 127, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
WIDTHS = (1, 2, 4, 8)


def damaged(seeds: Sequence[bytes], tokens: Sequence[bytes], random: Random) -> bytes:
    """One of the seeds, damaged in one to six ways."""
    content = random.choice(seeds)
    for _ in range(random.choice((1, 1, 1, 2, 2, 3, 4, 6))):
        content = random.choice(WAYS)(content, seeds, tokens, random)[:MAX_SIZE]
    return content


def made(reader: Reader, random: Random) -> bytes:
    """An input for a reader: a damaged file, or one that is made up, which may be damaged too."""
    if reader.made is None or random.random() < 0.5:
        return damaged(reader.seeds, reader.tokens, random)
    content = reader.made(random)
    return damaged([content], reader.tokens, random) if random.random() < 0.3 else content


Seeds = Sequence[bytes]


def _span(content: bytes, random: Random, longest: int = 200) -> tuple[int, int]:
    start = random.randint(0, len(content))
    return start, min(len(content), start + random.randint(0, longest))


def _flip(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 2, 8)) if content else 0):
        changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def _byte(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    place = random.randint(0, len(content))
    return content[:place] + bytes([random.randrange(256)]) + content[place + 1:]


def _cut(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    return content[:random.randint(0, len(content))]


def _delete(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    start, end = _span(content, random)
    return content[:start] + content[end:]


def _repeat(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    start, end = _span(content, random)
    times = random.choice((2, 2, 3, 30, 300))
    return content[:start] + content[start:end] * times + content[end:]


def _splice(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    other = random.choice(seeds)
    start, end = _span(other, random, 2000)
    place, until = _span(content, random)
    return content[:place] + other[start:end] + content[until:]


def _insert(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    place = random.randint(0, len(content))
    return content[:place] + random.choice((*tokens, *PIECES)) + content[place:]


def _replace(
    pattern: re.Pattern[bytes], content: bytes, by: Callable[[], bytes], random: Random
) -> bytes:
    places = [found.span() for found in pattern.finditer(content)]
    if not places:
        return content
    start, end = random.choice(places)
    return content[:start] + by() + content[end:]


def _number(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    return _replace(NUMBER, content, lambda: random.choice(NUMBERS), random)


def _word(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    return _replace(WORD, content, lambda: random.choice((*tokens, *PIECES, *NUMBERS)), random)


def _integer(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    width = random.choice(WIDTHS)
    value = random.choice(INTEGERS) % 256**width
    place = random.randint(0, max(0, len(content) - width))
    order = random.choice(("big", "little"))
    return (content[:place] + value.to_bytes(width, "big" if order == "big" else "little")
            + content[place + width:])


def _lines(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    lines = content.split(b"\n")
    here, there = random.randrange(len(lines)), random.randrange(len(lines))
    way = random.randrange(3)
    if way == 0:
        lines[here], lines[there] = lines[there], lines[here]
    elif way == 1:
        lines.insert(here, lines[there])
    else:
        del lines[here]
    return b"\n".join(lines)


def _encode(content: bytes, seeds: Seeds, tokens: Seeds, random: Random) -> bytes:
    text = content.decode("latin-1")
    return random.choice((
        lambda: text.encode("utf-16"), lambda: text.encode("utf-8"), lambda: text.encode("utf-32"),
        lambda: b"\xef\xbb\xbf" + content, lambda: content.replace(b"\n", b"\r"),
        lambda: content.replace(b"\n", b"\r\n"), lambda: content.upper(), lambda: content[::-1],
        lambda: content.replace(b",", b";").replace(b".", b",")))()


WAYS = (_flip, _flip, _byte, _cut, _delete, _repeat, _splice, _insert, _insert, _number, _number,
        _number, _word, _integer, _integer, _lines, _encode)
