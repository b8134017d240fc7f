"""Certificates of an authority of one's own, for TLS on the loopback."""

from __future__ import annotations

import datetime

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID


def write_certificates(folder):
    """Write ``ca.pem``, and ``cert.pem`` with ``key.pem`` that it has signed; return the three paths."""
    folder.mkdir(exist_ok=True)
    authority, own = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    root = _certificate("test authority", authority, "test authority", authority, authority=True)
    leaf = _certificate("test node", own, "test authority", authority, authority=False)
    paths = folder / "ca.pem", folder / "cert.pem", folder / "key.pem"
    for path, one in zip(paths, (root, leaf), strict=False):
        path.write_bytes(one.public_bytes(serialization.Encoding.PEM))
    form = serialization.PrivateFormat.PKCS8
    paths[2].write_bytes(own.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption()))
    return tuple(map(str, paths))


def _certificate(name, key, issuer, signer, *, authority):
    named = [x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, one)]) for one in (name, issuer)]
    now = datetime.datetime.now(datetime.UTC)
    day = datetime.timedelta(days=1)
    builder = (
        x509.CertificateBuilder()
        .subject_name(named[0])
        .issuer_name(named[1])
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - day)
        .not_valid_after(now + day)
        .add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
    )
    return builder.sign(signer, hashes.SHA256())
