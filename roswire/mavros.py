"""The commonly used definitions of mavros_msgs in ROS Noetic, which the type store of `rosbags` lacks."""

_HEADER = "std_msgs/Header header\n"
_MOTION = "geometry_msgs/Vector3 velocity\ngeometry_msgs/Vector3 acceleration_or_force\nfloat32 yaw\nfloat32 yaw_rate\n"
_RESULT = "bool success\nuint8 result\n"

# The modes of State by autopilot; the value of a mode is its name, or the text after the colon.
_MODES = {
    "APM_PLANE": "MANUAL CIRCLE STABILIZE TRAINING ACRO FBWA FBWB CRUISE AUTOTUNE AUTO RTL LOITER LAND GUIDED"
    " INITIALISING QSTABILIZE QHOVER QLOITER QLAND QRTL",
    "APM_COPTER": "STABILIZE ACRO ALT_HOLD AUTO GUIDED LOITER RTL CIRCLE POSITION LAND OF_LOITER DRIFT SPORT FLIP"
    " AUTOTUNE POSHOLD BRAKE THROW AVOID_ADSB GUIDED_NOGPS",
    "APM_ROVER": "MANUAL LEARNING STEERING HOLD AUTO RTL GUIDED INITIALISING",
    "PX4": "MANUAL ACRO ALTITUDE:ALTCTL POSITION:POSCTL OFFBOARD STABILIZED RATTITUDE MISSION:AUTO.MISSION"
    " LOITER:AUTO.LOITER RTL:AUTO.RTL LAND:AUTO.LAND RTGS:AUTO.RTGS READY:AUTO.READY TAKEOFF:AUTO.TAKEOFF",
}
_FRAMES = (
    "GLOBAL LOCAL_NED MISSION GLOBAL_REL_ALT LOCAL_ENU GLOBAL_INT GLOBAL_RELATIVE_ALT_INT LOCAL_OFFSET_NED BODY_NED"
    " BODY_OFFSET_NED GLOBAL_TERRAIN_ALT GLOBAL_TERRAIN_ALT_INT BODY_FRD RESERVED_13 RESERVED_14 RESERVED_15"
    " RESERVED_16 RESERVED_17 RESERVED_18 RESERVED_19 LOCAL_FRD LOCAL_FLU"
)
_IGNORED = "IGNORE_VX IGNORE_VY IGNORE_VZ IGNORE_AFX IGNORE_AFY IGNORE_AFZ FORCE IGNORE_YAW IGNORE_YAW_RATE"


def _counted(kind: str, prefix: str, names: str) -> str:
    return "".join(f"{kind} {prefix}{name}={number}\n" for number, name in enumerate(names.split()))


def _bits(kind: str, names: str) -> str:
    return "".join(f"{kind} {name}={1 << number}\n" for number, name in enumerate(names.split()))


def _modes() -> str:
    lines = []
    for autopilot, modes in _MODES.items():
        for mode in modes.split():
            name, _, value = mode.partition(":")
            lines.append(f"string MODE_{autopilot}_{name}={value or name}\n")
    return "".join(lines)


MAVROS = {
    "geographic_msgs/GeoPoint.msg": "float64 latitude\nfloat64 longitude\nfloat64 altitude\n",
    "mavros_msgs/State.msg": (
        f"{_HEADER}bool connected\nbool armed\nbool guided\nbool manual_input\nstring mode\n"
        f"uint8 system_status\n{_modes()}"
    ),
    "mavros_msgs/ExtendedState.msg": (
        _counted("uint8", "VTOL_STATE_", "UNDEFINED TRANSITION_TO_FW TRANSITION_TO_MC MC FW")
        + _counted("uint8", "LANDED_STATE_", "UNDEFINED ON_GROUND IN_AIR TAKEOFF LANDING")
        + f"{_HEADER}uint8 vtol_state\nuint8 landed_state\n"
    ),
    "mavros_msgs/StatusText.msg": (
        _counted("uint8", "", "EMERGENCY ALERT CRITICAL ERROR WARNING NOTICE INFO DEBUG")
        + f"{_HEADER}uint8 severity\nstring text\n"
    ),
    "mavros_msgs/HomePosition.msg": (
        f"{_HEADER}geographic_msgs/GeoPoint geo\ngeometry_msgs/Point position\n"
        "geometry_msgs/Quaternion orientation\ngeometry_msgs/Vector3 approach\n"
    ),
    "mavros_msgs/Altitude.msg": (
        f"{_HEADER}float32 monotonic\nfloat32 amsl\nfloat32 local\nfloat32 relative\nfloat32 terrain\n"
        "float32 bottom_clearance\n"
    ),
    "mavros_msgs/VFR_HUD.msg": (
        f"{_HEADER}float32 airspeed\nfloat32 groundspeed\nint16 heading\nfloat32 throttle\nfloat32 altitude\n"
        "float32 climb\n"
    ),
    "mavros_msgs/RCIn.msg": f"{_HEADER}uint8 rssi\nuint16[] channels\n",
    "mavros_msgs/RCOut.msg": f"{_HEADER}uint16[] channels\n",
    "mavros_msgs/OverrideRCIn.msg": (
        "uint16 CHAN_RELEASE=0\nuint16 CHAN_NOCHANGE=65535\nuint16[18] channels\n"
    ),
    "mavros_msgs/Thrust.msg": f"{_HEADER}float32 thrust\n",
    "mavros_msgs/AttitudeTarget.msg": (
        f"{_HEADER}uint8 type_mask\nuint8 IGNORE_ROLL_RATE=1\nuint8 IGNORE_PITCH_RATE=2\nuint8 IGNORE_YAW_RATE=4\n"
        "uint8 IGNORE_THRUST=64\nuint8 IGNORE_ATTITUDE=128\n"
        "geometry_msgs/Quaternion orientation\ngeometry_msgs/Vector3 body_rate\nfloat32 thrust\n"
    ),
    "mavros_msgs/PositionTarget.msg": (
        f"{_HEADER}uint8 coordinate_frame\nuint8 FRAME_LOCAL_NED=1\nuint8 FRAME_LOCAL_OFFSET_NED=7\n"
        "uint8 FRAME_BODY_NED=8\nuint8 FRAME_BODY_OFFSET_NED=9\nuint16 type_mask\n"
        + _bits("uint16", f"IGNORE_PX IGNORE_PY IGNORE_PZ {_IGNORED}")
        + f"geometry_msgs/Point position\n{_MOTION}"
    ),
    "mavros_msgs/GlobalPositionTarget.msg": (
        f"{_HEADER}uint8 coordinate_frame\nuint8 FRAME_GLOBAL_INT=5\nuint8 FRAME_GLOBAL_REL_ALT=6\n"
        "uint8 FRAME_GLOBAL_TERRAIN_ALT=11\nuint16 type_mask\n"
        + _bits("uint16", f"IGNORE_LATITUDE IGNORE_LONGITUDE IGNORE_ALTITUDE {_IGNORED}")
        + f"float64 latitude\nfloat64 longitude\nfloat32 altitude\n{_MOTION}"
    ),
    "mavros_msgs/Waypoint.msg": (
        f"uint8 frame\n{_counted('uint8', 'FRAME_', _FRAMES)}uint16 command\nbool is_current\nbool autocontinue\n"
        "float32 param1\nfloat32 param2\nfloat32 param3\nfloat32 param4\nfloat64 x_lat\nfloat64 y_long\nfloat64 z_alt\n"
    ),
    "mavros_msgs/WaypointList.msg": "uint16 current_seq\nmavros_msgs/Waypoint[] waypoints\n",
    "mavros_msgs/WaypointReached.msg": f"{_HEADER}uint16 wp_seq\n",
    "mavros_msgs/CommandBool.srv": f"bool value\n---\n{_RESULT}",
    "mavros_msgs/CommandTOL.srv": (
        f"float32 min_pitch\nfloat32 yaw\nfloat32 latitude\nfloat32 longitude\nfloat32 altitude\n---\n{_RESULT}"
    ),
    "mavros_msgs/CommandLong.srv": (
        "bool broadcast\nuint16 command\nuint8 confirmation\n"
        + "".join(f"float32 param{number}\n" for number in range(1, 8))
        + f"---\n{_RESULT}"
    ),
    "mavros_msgs/SetMode.srv": (
        "uint8 MAV_MODE_PREFLIGHT=0\n"
        + "".join(
            f"uint8 MAV_MODE_{mode}_{state}={value + armed}\n"
            for mode, value in (("STABILIZE", 80), ("MANUAL", 64), ("GUIDED", 88), ("AUTO", 92), ("TEST", 66))
            for state, armed in (("DISARMED", 0), ("ARMED", 128))
        )
        + "uint8 base_mode\nstring custom_mode\n---\nbool mode_sent\n"
    ),
}
