"""Colours of all figures: the palette of Okabe and Ito (2008), distinguishable with any colour vision."""

JOINT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
INK, FAINT, GRID_LINE = "#222222", "#9AA3AB", "#D5DADF"
HOLD_COLOUR, PUSH_COLOUR = "#E8EEF4", "#F9E3B4"
ALONE_COLOUR, CARRYING_COLOUR, RATED_COLOUR, PEAK_COLOUR = JOINT_COLOURS
