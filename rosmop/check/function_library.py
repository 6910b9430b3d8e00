"""The functions of the library that are written in the language itself.

Interpreter, module and proof treat them as helper functions, so they give the same bits. Each specification
has its own copy of the functions that it calls, one for each type of the `auto` parameters.
"""

from collections.abc import Sequence
from functools import cache, partial

from rosmop.check.assignables import Value, Variable
from rosmop.check.conversion import number
from rosmop.check.scope import FunctionScope, HelperFunction
from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.text import tree
from rosmop.text.parser import parse
from rosmop.types import value_types
from rosmop.types.resolve import resolve
from rosmop.types.value_types import Type

TEXT = """library() {
double turned(double x, double quarters) {
    double turns = (x * 6.36619772367581382433e-01 + 6755399441055744.0) - 6755399441055744.0;
    double first = turns * 1.57079632673412561417e00, a = x - first;
    double second = turns * 6.07710050630396597660e-11, b = a - second;
    double third = turns * 2.02226624871116645580e-21, c = b - third;
    double low = turns * 8.47842766036889956997e-32 - ((b - c) - third);
    double y = c - low, z = (c - y) - low, whole = turns + quarters;
    double quarter = whole - 4.0 * ((whole * 0.25 + 6755399441055744.0) - 6755399441055744.0);
    double s = y * y, value = 0;
    if (fabs(quarter) == 1) {
        double t = s * s;
        double r = s * (4.16666666666666019037e-02 + s * (-1.38888888888741095749e-03 + s * 2.48015872894767294178e-05))
            + t * t
            * (-2.75573143513906633035e-07 + s * (2.08757232129817482790e-09 + s * -1.13596475577881948265e-11));
        double half = 0.5 * s, one = 1.0 - half;
        value = one + (((1.0 - one) - half) + (s * r - y * z));
    } else {
        double r = 8.33333333332248946124e-03 + s * (-1.98412698298579493134e-04 + s * 2.75573137070700676789e-06)
            + s * (s * s) * (-2.50507602534068634195e-08 + s * 1.58969099521155010221e-10);
        double cube = s * y;
        value = y - ((s * (0.5 * z - cube * r) - z) - cube * -1.66666666666666324348e-01);
    }
    return quarter < 0 || quarter > 1 ? -value : value;
}
double sin(double x) { if (fabs(x) <= 1048576) { return turned(x, 0); } return sin_of_c(x); }
double cos(double x) { if (fabs(x) <= 1048576) { return turned(x, 1); } return cos_of_c(x); }
double atan2(double y, double x) {
    double height = fabs(y), width = fabs(x);
    if (!(height <= INFINITY && width <= INFINITY)) { return x + y; }
    if (height > width * 1.152921504606847e+18) { return copysign(1.57079632679489655800, y); }
    double angle = 0;
    if (height == width) {
        if (height > 0) { angle = 7.85398163397448278999e-01; }
    } else {
        double r = height / width, high = 0, low = 0, v = r;
        if (r >= 2.4375) {
            high = 1.57079632679489655800; low = 6.12323399573676603587e-17; v = -1.0 / r;
        } else if (r >= 1.1875) {
            high = 9.82793723247329054082e-01; low = 1.39033110312309984516e-17; v = (r - 1.5) / (1.0 + 1.5 * r);
        } else if (r >= 0.6875) {
            high = 7.85398163397448278999e-01; low = 3.06161699786838301793e-17; v = (r - 1.0) / (r + 1.0);
        } else if (r >= 0.4375) {
            high = 4.63647609000806093515e-01; low = 2.26987774529616870924e-17; v = (2.0 * r - 1.0) / (2.0 + r);
        }
        double z = v * v, w = z * z;
        double odd = z * (3.33333333333329318027e-01 + w * (1.42857142725034663711e-01 + w * (9.09088713343650656196e-02
            + w * (6.66107313738753120669e-02 + w * (4.97687799461593236017e-02 + w * 1.62858201153657823623e-02)))));
        double even = w * (-1.99999999998764832476e-01 + w * (-1.11111104054623557880e-01
            + w * (-7.69187620504482999495e-02 + w * (-5.83357013379057348645e-02 + w * -3.65315727442169155270e-02))));
        angle = high - ((v * (odd + even) - low) - v);
    }
    return copysign(copysign(1.0, x) < 0 ? M_PI - (angle - 1.2246467991473531772e-16) : angle, y);
}
double hypot(double x, double y) {
    double a = fabs(x), b = fabs(y);
    if (a == INFINITY || b == INFINITY) { return INFINITY; }
    if (b > a) { double c = a; a = b; b = c; }
    if (b < a * 2.7755575615628914e-17) { return a + b; }
    double scale = 1.0;
    if (a > 3.3519519824856493e+153) { scale = 1.90109156629516e-211; }
    else if (b < 3.4395525670743494e-136) { scale = 5.260135901548374e+210; }
    a *= scale; b *= scale;
    double p = a * 134217729.0, high = (a - p) + p, low = a - high;
    double q = b * 134217729.0, higher = (b - q) + q, lower = b - higher;
    double aa = a * a, bb = b * b;
    double rest = ((higher * higher - bb) + 2.0 * higher * lower + lower * lower)
        + ((high * high - aa) + 2.0 * high * low + low * low);
    return sqrt(rest + bb + aa) / scale;
}
double clamp(double x, double lo, double hi) {
    if (x > hi) { return hi; }
    if (x < lo) { return lo; }
    if (x >= lo && x <= hi) { return x; }
    return lo > 0 ? lo : hi < 0 ? hi : 0;
}
bool inside(double x, double y, auto p) {
    bool in = false;
    long n = p.size();
    if (n < 6 || n % 2 != 0) { return false; }
    double ax = p[n - 2], ay = p[n - 1];
    for (long i = 0; i < n; i += 2) {
        double bx = p[i], by = p[i + 1];
        if ((ay > y) != (by > y) && x < (bx - ax) * (y - ay) / (by - ay) + ax) { in = !in; }
        ax = bx; ay = by;
    }
    return in;
}
double distance(double x, double y, auto p) {
    double least = INFINITY;
    long n = p.size();
    if (n < 6 || n % 2 != 0 || !isfinite(x) || !isfinite(y)) { return 0; }
    double ax = p[n - 2], ay = p[n - 1];
    for (long i = 0; i < n; i += 2) {
        double bx = p[i], by = p[i + 1];
        double ex = bx - ax, ey = by - ay, length = ex * ex + ey * ey;
        double t = length > 0 ? clamp(((x - ax) * ex + (y - ay) * ey) / length, 0, 1) : 0;
        double dx = ax + t * ex - x, dy = ay + t * ey - y;
        if (dx * dx + dy * dy < least) { least = dx * dx + dy * dy; }
        ax = bx; ay = by;
    }
    return sqrt(least);
}
double yaw(auto q) {
    return atan2(2 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z);
}
double metres_north(double lat, double lon, double lat0, double lon0) {
    double s = sin(lat0 * (M_PI / 180)), w = 1 - 0.00669437999014 * s * s;
    return (lat - lat0) * (M_PI / 180) * (6378137 * (1 - 0.00669437999014)) / (w * sqrt(w));
}
double metres_east(double lat, double lon, double lat0, double lon0) {
    double s = sin(lat0 * (M_PI / 180)), w = 1 - 0.00669437999014 * s * s, d = lon - lon0;
    if (d > 180) { d -= 360; }
    if (d < -180) { d += 360; }
    return d * (M_PI / 180) * 6378137 * cos(lat0 * (M_PI / 180)) / sqrt(w);
}
long index(auto names, std::string name) {
    for (long i = 0; i < names.size(); i++) { if (names[i] == name) { return i; } }
    return -1;
}
std::string sender(std::string node, std::string host) {
    if (node == "") { return "a monitor"; }
    if (host == "") { return node; }
    return node + " of " + host;
}
std::string silence(std::string topic, std::string node, std::string host, double since, double limit) {
    if (since == INFINITY) { return "no message on " + topic + " since the guard began"; }
    char text[100];
    snprintf(text, 100, " for %.2f s (limit %g s)", since, limit);
    return "no message from " + sender(node, host) + " on " + topic + text;
}
std::string intrusion(std::string topic, std::string node, std::string host, double since, double limit) {
    char text[100];
    snprintf(text, 100, ", last %.2f s ago (limit %g s)", since, limit);
    return sender(node, host) + " also publishes on " + topic + text;
}
bool isfinite_all(auto values) {
    for (long i = 0; i < values.size(); i++) { if (!isfinite(values[i])) { return false; } }
    return true;
}
} """

ELEMENTARY = frozenset({"sin", "cos", "atan2", "hypot"})
"""The functions that the interpreter has in Python, with the same bits (`runtime/numbers.py`)."""

FREE = ELEMENTARY | {"turned"}


@cache
def functions() -> dict[str, tree.FunctionDefinition]:
    [library] = parse(TEXT, "library.rv").specifications
    return {function.name: function for function in library.functions}


def is_polygon(kind: Type) -> bool:
    return isinstance(kind, value_types.VectorType) and value_types.is_number(kind.element)


def is_names(kind: Type) -> bool:
    return isinstance(kind, value_types.VectorType) and isinstance(kind.element, value_types.StringType)


def is_quaternion(kind: Type) -> bool:
    return kind == value_types.RecordType("geometry_msgs/Quaternion")


def invoke(scope: FunctionScope, name: str, values: Sequence[Value]) -> nodes.Expression:
    """Call a function. Arguments for parameters that are not `auto` must already have the right types."""
    function = _instance(scope, functions()[name], [value.type for value in values])
    given = [
        number(value.form, parameter.type) if value_types.is_number(parameter.type) else value.form
        for value, parameter in zip(values, function.parameters, strict=True)
    ]
    return nodes.Invoke(function.result, function.code, tuple(given), None)


def all_finite(scope: FunctionScope, value: Value) -> nodes.Expression:
    kind = value.type
    if isinstance(kind, value_types.FloatingType):
        return nodes.Call(value_types.BOOL, "h_isfinite", (value.form,))
    if isinstance(kind, value_types.VectorType) and _has_floats(scope, kind):
        return invoke(scope, "isfinite_all", [value])
    parts: list[nodes.Expression] = []
    if isinstance(kind, value_types.RecordType):
        for place, field in enumerate(scope.values.fields(kind)):
            if _has_floats(scope, field):
                parts.append(all_finite(scope, Value(nodes.Item(field, value.form, place), value.position)))
    result: nodes.Expression = parts.pop() if parts else nodes.Literal(value_types.BOOL, True)
    while parts:
        result = nodes.Logical("and", parts.pop(), result)
    return result


def _has_floats(scope: FunctionScope, kind: Type) -> bool:
    if isinstance(kind, value_types.VectorType):
        return _has_floats(scope, kind.element)
    if isinstance(kind, value_types.RecordType):
        return any(map(partial(_has_floats, scope), scope.values.fields(kind)))
    return isinstance(kind, value_types.FloatingType)


def _instance(scope: FunctionScope, node: tree.FunctionDefinition, kinds: Sequence[Type]) -> HelperFunction:
    is_any = [parameter.type.name == ("auto",) for parameter in node.parameters]
    key = (node.name, *(kind for kind, any_type in zip(kinds, is_any, strict=True) if any_type))
    instances = scope.names.instances
    if key not in instances:
        parameters = [
            Variable(
                parameter.name,
                kind if any_type else resolve(parameter.type, scope.messages),
                scope.symbols.fresh("v"),
                parameter.position,
                constant=True,
            )
            for parameter, kind, any_type in zip(node.parameters, kinds, is_any, strict=True)
        ]
        assert node.type is not None  # each function of the library has a result
        instances[key] = HelperFunction(
            node.name,
            scope.symbols.fresh(nodes.PURE),
            resolve(node.type, scope.messages),
            tuple(parameters),
            (),
            node,
        )
    return instances[key]


def check_polygon(value: Value) -> None:
    assert isinstance(value.type, value_types.VectorType)  # the caller checks this
    length = value.type.length
    if length is not None and (length < 6 or length % 2):
        raise SpecificationError.at(
            value.position,
            f"a polygon is x and y of each corner in turn, so it has an even number of at least 6 values,"
            f" not {length}",
        )
