import itertools

from appliance.signing.fingerprints import file_name, fingerprint, fingerprint_of_all

NAMES = [
    "a.rv", "b.rv", "msg/p/T.msg", "..", "../a.rv", ".", "a/./b", "a//b", "/a", "a\nb", "a%0Ab", "%", "", "é.rv",
    "c:\\x", "%2E%2E", "...",
]  # fmt: skip


def test_usual_names_stay_and_unusual_ones_are_safe_paths() -> None:
    shown = [file_name(name) for name in NAMES]
    assert shown[:3] == NAMES[:3]
    assert len(set(shown)) == len(NAMES)
    for name in shown:
        assert name.isascii()
        assert not {"", ".", ".."} & set(name.split("/"))
        assert not set("\\\n:") & set(name)


def test_no_two_sets_of_texts_have_one_hash() -> None:
    sets = [
        {"a": "1", "b": "2"},
        {"a": "2", "b": "1"},
        {"a": "1"},
        {"b": "1"},
        {"a": "1", "b": "2", "c": ""},
        {},
    ]
    sets += [{f"a\n{fingerprint('2')}  b": "1"}]
    found = [fingerprint_of_all(one) for one in sets]
    assert all(one != other for one, other in itertools.combinations(found, 2))
    assert fingerprint_of_all({"b": "2", "a": "1"}) == found[0]
