from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.signing.site_keys import public_line, sign

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
OTHER_KEY = Ed25519PrivateKey.from_private_bytes(bytes(32))
LINE = f"{public_line(KEY)} site 2026"
OTHER_LINE = f"{public_line(OTHER_KEY)} next"
NAME = "SHA256:lbmsoA0yIEcEiVDRnMWuzm+nV+3ZEEpVIURqFoeSspg (site 2026)"


def signed(text: str, key: Ed25519PrivateKey = KEY) -> str:
    return sign(text, key)
