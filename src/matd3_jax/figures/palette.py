"""Colours of drawings as (red, green, blue), 0 to 255: those of Okabe and Ito, told apart with any colour vision."""

Colour = tuple[int, int, int]

BLACK: Colour = (0, 0, 0)
WHITE: Colour = (255, 255, 255)
GREY: Colour = (130, 130, 130)
DARK_GREY: Colour = (77, 77, 77)

BLUE: Colour = (0, 114, 178)
VERMILION: Colour = (213, 94, 0)
GREEN: Colour = (0, 158, 115)
PURPLE: Colour = (204, 121, 167)
ORANGE: Colour = (230, 159, 0)
SKY_BLUE: Colour = (86, 180, 233)
YELLOW: Colour = (240, 228, 66)
PALE_GREEN: Colour = (166, 219, 203)
"""Green mixed with white, for what lies under everything else."""

TEAM: dict[str, Colour] = {"agents": BLUE, "adversaries": VERMILION}
"""Where teams matter."""

AGENT: tuple[Colour, ...] = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY_BLUE, YELLOW)
"""Where each agent has a colour of its own; repeated beyond the last."""
