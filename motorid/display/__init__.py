"""How results show themselves: `numbers` and `tables` for text, `cards` for notebooks and reports."""
