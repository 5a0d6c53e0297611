"""Printed boards: designs that fill a board, their pages, and the target block of rig.yaml."""

from calgraph.printing.designs import DEFAULT_SIZE, BoardKind, BoardOptions, design_board
from calgraph.printing.pages import Page, Paper, Window, choose_paper, layout_pages, parse_paper, parse_size
from calgraph.printing.target_block import format_target, read_boards, replace_target

__all__ = [
    "DEFAULT_SIZE", "BoardKind", "BoardOptions", "Page", "Paper", "Window", "choose_paper", "design_board",
    "format_target", "layout_pages", "parse_paper", "parse_size", "read_boards", "replace_target",
]  # fmt: skip
