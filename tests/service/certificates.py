"""Certificates made for a test, by the openssl command."""

import subprocess
from dataclasses import dataclass
from pathlib import Path

KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")


@dataclass(frozen=True)
class Signed:
    """Files of a certificate and its key."""

    certificate: Path
    key: Path


class Authority:
    """Vouches for whoever asks."""

    def __init__(self, folder):
        self.folder = folder
        self.own = Signed(folder / "ca.pem", folder / "ca.key")
        openssl("req", "-x509", *KEY, "-keyout", self.own.key, "-out", self.own.certificate,
                "-days", "2", "-subj", "/CN=test authority")  # fmt: skip

    def signed(self, name, alternative_names):
        """A certificate with subject alternative names such as `IP:127.0.0.1`."""
        files = Signed(self.folder / f"{name}.pem", self.folder / f"{name}.key")
        request, extensions = self.folder / f"{name}.csr", self.folder / f"{name}.ext"
        extensions.write_text(f"subjectAltName={alternative_names}")
        openssl("req", "-new", *KEY, "-keyout", files.key, "-out", request, "-subj", f"/CN={name}")
        openssl("x509", "-req", "-in", request, "-CA", self.own.certificate,
                "-CAkey", self.own.key, "-CAcreateserial", "-days", "2",
                "-extfile", extensions, "-out", files.certificate)  # fmt: skip
        return files


def openssl(*arguments):
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)
