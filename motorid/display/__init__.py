"""How results show themselves: `numbers` for people, `tables` as text and HTML, `cards` of both.

Knows nothing of motors. Entry: `Shown` in `cards`, the base of every result, which writes its own card.
"""
