"""How results show themselves: `numbers` for people, `cards` with tables as text and HTML; knows nothing of motors."""
