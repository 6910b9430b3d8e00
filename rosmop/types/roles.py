"""The roles of topics: which values messages of each type have, in the language itself.

Rows are only added: a row that changes would change guards in use.
"""

from collections.abc import Mapping
from functools import lru_cache

ANY_TYPE = "*"
"""Stands for each type without a row of its own."""

ROLES = """
// Commands of a velocity. A steered base has no sideways motion and no turn of its own.
role Velocity(double x, double y, double z, double rx, double ry, double rz, double steer, double steerRate,
              double acceleration, double jerk) {
    geometry_msgs/Twist '{linear:{x:x, y:y, z:z}, angular:{x:rx, y:ry, z:rz}}';
    geometry_msgs/TwistStamped '{twist:{linear:{x:x, y:y, z:z}, angular:{x:rx, y:ry, z:rz}}}';
    ackermann_msgs/AckermannDrive '{speed:x, steering_angle:steer, steering_angle_velocity:steerRate,
        acceleration:acceleration, jerk:jerk}';
    ackermann_msgs/AckermannDriveStamped '{drive:{speed:x, steering_angle:steer, steering_angle_velocity:steerRate,
        acceleration:acceleration, jerk:jerk}}';
}

role Trajectory(std::string[] names, trajectory_msgs::JointTrajectoryPoint[] points) {
    trajectory_msgs/JointTrajectory '{joint_names:names, points:points}';
    control_msgs/FollowJointTrajectoryActionGoal '{goal.trajectory:{joint_names:names, points:points}}' cancel;
}

// The stamp is that of the trajectory, which begins then; zero: when it arrives.
role StampedTrajectory(std::string[] names, trajectory_msgs::JointTrajectoryPoint[] points, ros::Time stamp) {
    trajectory_msgs/JointTrajectory '{header.stamp:stamp, joint_names:names, points:points}';
    control_msgs/FollowJointTrajectoryActionGoal
        '{goal.trajectory:{header.stamp:stamp, joint_names:names, points:points}}' cancel;
}

// What moves a base or an arm.
role Command() : Velocity {
    trajectory_msgs/JointTrajectory '{}';
    control_msgs/FollowJointTrajectoryActionGoal '{}' cancel;
    move_base_msgs/MoveBaseActionGoal '{}' cancel;
}

role Goal(std::string id) {
    move_base_msgs/MoveBaseActionGoal '{goal_id.id:id}';
    control_msgs/FollowJointTrajectoryActionGoal '{goal_id.id:id}';
}

role Result(std::string id) {
    move_base_msgs/MoveBaseActionResult '{status.goal_id.id:id}';
    control_msgs/FollowJointTrajectoryActionResult '{status.goal_id.id:id}';
}

role Pose(double px, double py, geometry_msgs::Quaternion q) {
    nav_msgs/Odometry '{pose.pose:{position.x:px, position.y:py, orientation:q}}';
    geometry_msgs/PoseStamped '{pose:{position.x:px, position.y:py, orientation:q}}';
    geometry_msgs/PoseWithCovarianceStamped '{pose.pose:{position.x:px, position.y:py, orientation:q}}';
}

// A fix has no direction. Its position is in metres from lat0 and lon0, which are given to the specification.
role Position() : Pose {
    sensor_msgs/NavSatFix(int fixed, double lat, double lon) '{status.status:fixed, latitude:lat, longitude:lon}' {
        bool known = fixed >= 0 && fixed <= 2;
        double px = known ? metres_east(lat, lon, lat0, lon0) : NAN;
        double py = known ? metres_north(lat, lon, lat0, lon0) : NAN;
        geometry_msgs::Quaternion q;
        q.w = NAN;
    }
}

// A measured velocity.
role Motion(double vx, double vy, double vz, double wx, double wy, double wz, double turn) {
    nav_msgs/Odometry '{twist.twist:{linear:{x:vx, y:vy, z:vz}, angular:{x:wx, y:wy, z:wz}, angular.z:turn}}';
    geometry_msgs/TwistStamped '{twist:{linear:{x:vx, y:vy, z:vz}, angular:{x:wx, y:wy, z:wz}, angular.z:turn}}';
    geometry_msgs/TwistWithCovarianceStamped
        '{twist.twist:{linear:{x:vx, y:vy, z:vz}, angular:{x:wx, y:wy, z:wz}, angular.z:turn}}';
}

// Values with their range, or none if one that has to be finite is not. Other types have the time of arrival only.
role Sensor(double low, double high, double[] values) {
    sensor_msgs/LaserScan(float low, float high, float[] values) '{range_min:low, range_max:high, ranges:values}';
    sensor_msgs/Range(double v, double low, double high) '{range:v, min_range:low, max_range:high}' {
        std::vector<double> values = {v};
    }
    sensor_msgs/NavSatFix(double lat, double lon, double altitude)
            '{latitude:lat, longitude:lon, altitude:altitude}' {
        std::vector<double> values = {lat, lon, altitude};
        if (!(isfinite(lat) && isfinite(lon))) { values.clear(); }
        double low = -INFINITY, high = INFINITY;
    }
    sensor_msgs/Imu(double wx, double wy, double wz, double ax, double ay, double az)
            '{angular_velocity:{x:wx, y:wy, z:wz}, linear_acceleration:{x:ax, y:ay, z:az}}' {
        std::vector<double> values = {wx, wy, wz, ax, ay, az};
        if (!(isfinite(wx) && isfinite(wy) && isfinite(wz) && isfinite(ax) && isfinite(ay) && isfinite(az))) {
            values.clear();
        }
        double low = -INFINITY, high = INFINITY;
    }
    nav_msgs/Odometry(double px, double py, double pz, double qx, double qy, double qz, double qw)
            '{pose.pose:{position:{x:px, y:py, z:pz}, orientation:{x:qx, y:qy, z:qz, w:qw}}}' {
        std::vector<double> values = {px, py, pz, qx, qy, qz, qw};
        if (!(isfinite(px) && isfinite(py) && isfinite(pz) && isfinite(qx) && isfinite(qy) && isfinite(qz)
              && isfinite(qw))) {
            values.clear();
        }
        double low = -INFINITY, high = INFINITY;
    }
    sensor_msgs/JointState(double[] values) '{position:values}' { double low = -INFINITY, high = INFINITY; }
    default '{}' {
        std::vector<double> values = {ros::Time::now().toSec()};
        double low = -INFINITY, high = INFINITY;
    }
}

role Scan(double first, double increment, double least, double most, float[] ranges) {
    sensor_msgs/LaserScan
        '{angle_min:first, angle_increment:increment, range_min:least, range_max:most, ranges:ranges}';
}

role Joints(std::string[] names, double[] found) {
    sensor_msgs/JointState '{name:names, position:found}';
}

role JointMotions(std::string[] names, double[] found, double[] moving, ros::Time stamp) {
    sensor_msgs/JointState '{header.stamp:stamp, name:names, position:found, velocity:moving}';
}

role Battery(double percentage) {
    sensor_msgs/BatteryState '{percentage:percentage}';
}

role Diagnostics(diagnostic_msgs::DiagnosticStatus[] statuses) {
    diagnostic_msgs/DiagnosticArray '{status:statuses}';
}

// A device that a person holds, such as the given button of a Joy.
role Enabler(bool held) {
    std_msgs/Bool '{data:held}';
    sensor_msgs/Joy(int[] buttons) '{buttons:buttons}' {
        bool held = button < buttons.size() && buttons[button] == 1;
    }
}

role Mode(bool byHand) {
    std_msgs/Bool '{data:byHand}';
}

role Switch(bool withheld) {
    std_msgs/Bool '{data:withheld}';
}

// What shows people and places.
role Private() {
    sensor_msgs/Image '{}';
    sensor_msgs/CompressedImage '{}';
    sensor_msgs/PointCloud2 '{}';
    sensor_msgs/LaserScan '{}';
    sensor_msgs/NavSatFix '{}';
    sensor_msgs/JointState '{}';
    nav_msgs/Odometry '{}';
    nav_msgs/OccupancyGrid '{}';
    geometry_msgs/PoseStamped '{}';
    geometry_msgs/PoseWithCovarianceStamped '{}';
    tf2_msgs/TFMessage '{}';
    std_msgs/String '{}';
}
"""


@lru_cache(maxsize=1)
def types_of_roles() -> Mapping[str, tuple[str, ...]]:
    """Return the types of each role, the default one first; `ANY_TYPE` stands for all others."""
    roles: dict[str, tuple[str, ...]] = {}
    role = ""
    for line in ROLES.splitlines():
        word = line.replace("(", " ").split(" ", 5)
        if line.startswith("role "):
            role = word[1]
            roles[role] = ()
        if ") : " in line and not line.startswith(" "):
            roles[role] = roles[line.rpartition(") : ")[2].removesuffix(" {")]
        elif line.startswith("    ") and line[4].isalpha():
            kind = word[4]
            if "/" in kind or kind == "default":
                roles[role] += (ANY_TYPE if kind == "default" else kind,)
    return roles
