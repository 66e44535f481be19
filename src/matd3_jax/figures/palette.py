"""Colors of drawings as (red, green, blue), 0 to 255: those of Okabe and Ito, told apart with any color vision."""

Color = tuple[int, int, int]

BLACK: Color = (0, 0, 0)
WHITE: Color = (255, 255, 255)
GREY: Color = (130, 130, 130)
DARK_GREY: Color = (77, 77, 77)

BLUE: Color = (0, 114, 178)
VERMILION: Color = (213, 94, 0)
GREEN: Color = (0, 158, 115)
PURPLE: Color = (204, 121, 167)
ORANGE: Color = (230, 159, 0)
SKY_BLUE: Color = (86, 180, 233)
YELLOW: Color = (240, 228, 66)
PALE_GREEN: Color = (166, 219, 203)
"""Green mixed with white, for what lies under everything else."""

TEAM: dict[str, Color] = {"agents": BLUE, "adversaries": VERMILION}
"""Where teams matter."""

AGENT: tuple[Color, ...] = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY_BLUE, YELLOW)
"""Where each agent has a color of its own; repeated beyond the last."""
