"""Characters in UTF-8, of which a token may hold a part: which continue a word, and what is left of a cut one.

Word characters are those of Unicode's classes letter, mark, number and connector punctuation (L, M, N, Pc), "_" among
them.  Everything else ends a word: punctuation of any script, symbols, blanks, broken UTF-8.
"""

import codecs
import functools
import sys
import unicodedata

import numpy as np

WORD, BREAK, BEGUN = 128, 129, 130
"""Units after the ASCII characters: another word character, one that ends a word, the first bytes of either."""

NOTHING, A_WORD, A_BREAK, BOTH = range(4)
"""Cases of the first bytes of a token: they complete no character, a word character, one that ends a word, or both."""

_PREFIX = ((), (WORD,), (BREAK,), (WORD, BREAK))
_ENDS_WORD, _IN_WORD = -2, -1  # leaves of the automaton; 0 is an invalid byte, others are nodes


def is_word(char: str) -> bool:
    """True if a character continues a word."""
    kind = unicodedata.category(char)
    return kind[0] in "LMN" or kind == "Pc"


class Spelling:
    """Tokens as units, with the pieces of characters that they begin and end with.

    Args:
      pieces: [V] the bytes of each token.

    Attributes:
      units: [V] units that a token writes by itself.
      head: int32 [V], row of `completes` and `leaves` that its first bytes take.
      tail: int32 [V], the node of a character that it begins and leaves open, −1 where a node stays as `leaves` says.
      completes: int32 [H, U], from the node of an open character to what a head completes.
      leaves: int32 [H, U], from the node to that after the head; node 0 is no open character.
    """

    def __init__(self, pieces: tuple[bytes, ...]) -> None:
        cut = [_cut(piece) for piece in pieces]
        self.units = [units for _, units, _ in cut]
        self.heads = list(dict.fromkeys([(b"", False), *((head, bool(units)) for head, units, _ in cut)]))
        self.is_cut = any(head or rest for head, _, rest in cut)
        row = {head: i for i, head in enumerate(self.heads)}
        self.head = np.array([row[head, bool(units)] for head, units, _ in cut], np.int32)
        self.tail = np.array([_node(rest) if rest else 0 if units else -1 for _, units, rest in cut], np.int32)
        nodes = range(len(_automaton()[0]) if self.is_cut else 1)
        fed = np.array([[_feed(node, *head) for node in nodes] for head in self.heads], np.int32)
        self.completes, self.leaves = fed[..., 0], fed[..., 1]

    def completed(self, token: int, case: int) -> tuple[int, ...]:
        """Units of a token after its first bytes completed what `case` says; its own where that cannot be."""
        has_head = bool(self.heads[self.head[token]][0])
        possible = (self.is_cut and self.units[token]) or has_head
        return (*(_PREFIX[case] if possible and (case == A_BREAK or has_head) else ()), *self.units[token])


def _cut(piece: bytes) -> tuple[bytes, tuple[int, ...], bytes]:
    """Bytes that continue a character, the units that follow, and the bytes of a character that is left open."""
    at = next((i for i, byte in enumerate(piece) if byte & 0xC0 != 0x80), len(piece))
    decoder = codecs.getincrementaldecoder("utf-8")("replace")
    text = decoder.decode(piece[at:])
    rest = decoder.getstate()[0]
    units = [ord(char) if char.isascii() else WORD if is_word(char) else BREAK for char in text]
    return piece[:at], (*units, *([BEGUN] if rest else [])), rest


def _feed(node: int, head: bytes, more: bool) -> tuple[int, int]:
    """Case of a head from a node, and the node after it; `more` bytes break what stays open."""
    found: list[bool] = []
    for byte in head:
        after = _automaton()[0][node][byte - 0x80] if node else 0
        node = max(after, 0)
        if after <= 0:
            found.append(after == _IN_WORD)
    if node and more:
        node = 0
        found.append(False)
    if not found:
        return NOTHING, node
    return (A_WORD if len(found) == 1 else BOTH) if found[0] else A_BREAK, node


def _node(prefix: bytes) -> int:
    """Node of the first bytes of a character."""
    nodes, leads = _automaton()
    node = leads[prefix[0]]
    for byte in prefix[1:]:
        node = nodes[node][byte - 0x80]
    return node


@functools.cache
def _automaton() -> tuple[list[tuple[int, ...]], dict[int, int]]:
    """Minimal automaton of the bytes after a lead byte: the 64 successors of each node, and each lead byte's node."""
    nodes: dict[tuple[int, ...], int] = {(): 0}
    leaves = [_IN_WORD if is_word(char) else _ENDS_WORD for char in map(chr, range(sys.maxunicode + 1))]
    leaves[0xD800:0xE000] = [0] * 0x800  # surrogates have no UTF-8

    def node(first: int, size: int, lowest: int) -> int:
        if size > 1:
            row = tuple(node(code, size // 64, lowest) for code in range(first, first + 64 * size, size))
        else:
            row = tuple(leaves[first : first + 64]) if first >= lowest else ()
        return nodes.setdefault(row, len(nodes)) if any(row) else 0

    leads = {0xC0 + i: node(i * 64, 1, 0x80) for i in range(2, 32)}
    leads |= {0xE0 + i: node(i * 4096, 64, 0x800) for i in range(16)}
    leads |= {0xF0 + i: node(i * 262144, 4096, 0x10000) for i in range(5)}
    return list(nodes), leads
