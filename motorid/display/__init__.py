"""How results show themselves: `numbers` for people, tables and `cards` as text and as HTML.

Knows nothing of motors. Entry: `Shown` in `cards`, the base of every result, which writes its own card.
"""
