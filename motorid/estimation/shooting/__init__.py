"""Hard constraints: multiple shooting as an NLP for IPOPT; `multiple_shooting.MultipleShooting` is the entry."""
