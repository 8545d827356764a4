"""Damage to the bytes of a file: what a bad cable, a bad disk or an interrupted copy leaves."""


def flipped(whole: bytes, *bits: int) -> bytes:
    """The same bytes with some bits the other way round."""
    damaged = bytearray(whole)
    for bit in bits:
        damaged[bit // 8] ^= 1 << (bit % 8)
    return bytes(damaged)


def flipped_byte(whole: bytes, place: int) -> bytes:
    """The same bytes with all bits of one of them the other way round."""
    return flipped(whole, *range(8 * place, 8 * place + 8))
