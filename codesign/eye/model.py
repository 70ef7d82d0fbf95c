"""Where each parameter of a frame sits in its row: what the renderer's picture reads.

Lengths are um; the camera is at the origin and looks along +z, x to the right, y down.
"""

LED_COUNT = 3
_VECTORS = ("centre", "face_x", "face_y", "face_z", "axis", "iris_x", "iris_y", "plane")
_LAMPS = ("lamp_a", "lamp_b", "lamp_c")
_NUMBERS = (
    "sclera_r", "cornea_r", "cornea_d", "limbus_r", "limbus_d", "pupil_r", "pupil_d",
    "index", "lid_r", "blend", "edge", "upper", "lower", "skew", "middle", "half",
    "crease", "iris", "iris_contrast", "sclera", "veins", "skin", "pores", "lashes",
    "pupil", "glint", "ambient", "gain", "brow", "t_iris", "t_vein", "t_skin", "t_fine",
    "t_lash", "offset_x", "offset_y", "turn_x", "turn_y", "caruncle",
)  # fmt: skip
NAMES = (*_VECTORS, *_LAMPS, *_NUMBERS)
# where each parameter of a frame sits in ``p``; three entries a vector
CENTRE, FACE_X, FACE_Y, FACE_Z, AXIS, IRIS_X, IRIS_Y, PLANE = range(0, 24, 3)
LED = 24
(
    SCLERA_R, CORNEA_R, CORNEA_D, LIMBUS_R, LIMBUS_D, PUPIL_R, PUPIL_D, INDEX, LID_R,
    BLEND, EDGE, UPPER, LOWER, SKEW, MIDDLE, HALF, CREASE, IRIS, IRIS_CONTRAST, SCLERA,
    VEINS, SKIN, PORES, LASHES, PUPIL, GLINT, AMBIENT, GAIN, BROW, T_IRIS, T_VEIN,
    T_SKIN, T_FINE, T_LASH, OFFSET_X, OFFSET_Y, TURN_X, TURN_Y, CARUNCLE,
) = range(33, 72)  # fmt: skip
COUNT = 72
