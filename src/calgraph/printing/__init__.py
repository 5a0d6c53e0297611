"""Boards on paper: designs that fill a sheet, their pages, and the target that rig.yaml needs for them."""

from calgraph.printing.designs import BoardKind, Wishes, design
from calgraph.printing.pages import Page, Window, lay_out
from calgraph.printing.paper import Paper, parse_paper, parse_size
from calgraph.printing.target_block import put_target, read_boards, target_block

__all__ = [
    "BoardKind", "Page", "Paper", "Window", "Wishes", "design", "lay_out", "parse_paper", "parse_size",
    "put_target", "read_boards", "target_block",
]  # fmt: skip
