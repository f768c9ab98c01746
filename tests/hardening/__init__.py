"""Hostile input by the thousand: each kind is a module with `TITLE`, `COUNT`, `FULL_COUNT` and `run`.

The tests run `COUNT` cases of each kind; ``make hardening`` runs `FULL_COUNT` and writes docs/results/reliability.md.
"""
