"""The functions that the intermediate form (`form/nodes.py`) may call, by name.

A first parameter `context` pays for the call. A last parameter `site` is the position of a fault.
"""

import inspect
import math
import operator
from collections.abc import Callable, Mapping
from types import MappingProxyType

from rosmop.runtime import formatting, numbers, strings, times, vectors

Function = Callable[..., object]

FUNCTIONS: Mapping[str, Function] = MappingProxyType(
    {
        # Places
        "a_put": vectors.put,
        "a_slot": vectors.put_slot,
        "a_character": strings.with_character,
        "a_part": times.with_part,
        # Characters in buffers
        "c_terminated": strings.until_zero,
        "e_character": strings.character,
        "e_repeat": strings.repeat,
        "e_filled": strings.fill,
        # The library
        **{f"h_{name}": function for name, (_, function) in numbers.MATH.items()},
        **{f"h_{name}f": function for name, function in numbers.FLOAT_MATH.items()},
        "h_min": min,
        "h_max": max,
        "h_sin_of_a_large_angle": numbers.sin,
        "h_cos_of_a_large_angle": numbers.cos,
        "h_signbit": numbers.signbit,
        "h_isnan": math.isnan,
        "h_isinf": math.isinf,
        "h_isfinite": math.isfinite,
        "h_to_integer": lambda value: b"%d" % value,
        "h_to_floating": lambda value: b"%f" % value,
        "h_parse": strings.parse_integer,
        "h_parse_floating": strings.parse_floating,
        "h_atoi": strings.lenient_integer,
        "h_atof": strings.lenient_floating,
        "h_filled": strings.fill,
        "h_filled_at_most": strings.filled_at_most,
        "h_printed": strings.print_into,
        "h_extended": strings.extend_buffer,
        "h_compare": strings.compare,
        "h_len": len,
        # Vectors
        "e_fill": vectors.filled_with,
        "k_after": operator.add,
        "k_before": operator.sub,
        "k_erase": vectors.erase,
        "k_insert": vectors.insert,
        "k_sort": vectors.sort,
        "k_reverse": vectors.reverse,
        "l_empty": operator.not_,
        "l_last": lambda values: len(values) - 1,
        "l_element": vectors.element,
        "l_append": vectors.append,
        "l_append_text": vectors.append_text,
        "l_pop": vectors.pop,
        "l_resized": vectors.resize,
        "l_filled": vectors.fill,
        "l_clear": list.clear,
        "l_len": len,
        "l_nearest": vectors.nearest,
        # Times
        "m_is_zero": operator.not_,
        "m_nsec": lambda value: value % times.BILLION,
        "m_sec": lambda value: value // times.BILLION,
        "m_seconds": lambda value: value / times.BILLION,
        "m_whole": lambda value: value,
        "m_nanoseconds": times.nanoseconds,
        "m_time": times.time,
        "m_duration": times.duration,
        "o_scaled": times.scale,
        # Output
        "p_integer": formatting.to_text_integer,
        "p_streamed": formatting.to_text_streamed,
        "p_fixed": formatting.to_text_fixed,
        "p_precise": formatting.to_text_precise,
        "p_character": formatting.to_text_character,
        "p_alternate": formatting.to_text_alternate,
        "p_hexadecimal": formatting.to_text_hexadecimal,
        "p_moment": formatting.to_text_moment,
        # Strings
        "o_join": strings.join,
        "o_extend": strings.extend,
        "o_charged": strings.charge,
        "t_byte": formatting.to_text_character,
        "t_last": lambda text: text[-1:],
        "t_zeroed": strings.with_zero,
        "t_member": strings.member,
        "t_substring": strings.substring,
        "t_find": strings.find,
        "t_find_last": strings.find_last,
        "t_find_any": strings.find_any,
        "t_compare": strings.compare,
        "t_resize": strings.resize,
        "t_erase": strings.erase,
        "t_insert": strings.insert,
        "t_replace": strings.replace,
        "t_shorten": strings.shorten,
        "t_extend": strings.extend,
    }
)


def _parameters(function: Function) -> tuple[str, ...]:
    try:
        return tuple(inspect.signature(function).parameters)
    except ValueError:  # a builtin of Python without a signature
        return ()


CHARGING = frozenset(
    name for name, function in FUNCTIONS.items() if _parameters(function)[:1] == ("context",)
)

FAULTING = frozenset(name for name, function in FUNCTIONS.items() if _parameters(function)[-1:] == ("site",))
