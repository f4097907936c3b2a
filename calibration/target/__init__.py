"""The calibration board: `board_page` prints it, `held_board` says how it is held, `detection` finds its corners."""
