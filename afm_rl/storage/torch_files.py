"""Files of others: members of a zip, and the tensors that ``torch.save`` wrote, in bounds.

``torch.load(weights_only=True)`` calls nothing of a file's own, but takes the memory and the time
that a file asks for. So what the file asks for is read first, and refused if it is more than
tensors.
"""

from __future__ import annotations

import io
import math
import pickletools
import re
import zipfile
from functools import partial

import torch
from torch import Tensor

LARGEST = 2**27  # bytes of a file, and of what is taken out of a zip
PIECE = 2**18  # bytes that are read of a zip at once, its table of contents among them
OPERATIONS = 2**14  # of a pickle; thirty describe a tensor
ASKED = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    *(f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16")),
}
"""What the description of real tensors asks for."""


class _InPieces(io.BytesIO):
    """Bytes that are read in small pieces."""

    def read(self, size: int | None = -1) -> bytes:
        if size is not None and size > PIECE:
            raise zipfile.BadZipFile(f"a table of contents of {size} bytes")
        return super().read(size)


class BoundedZip(zipfile.ZipFile):
    """A zip of somebody else's: what is read of it has bounds.

    Args:
        content: of the file.

    Raises:
        zipfile.BadZipFile: if it is no zip, or lists more files than a model has.

    >>> content = io.BytesIO()
    >>> with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
    ...     archive.writestr("zeros", bytes(10**6))
    >>> archive = BoundedZip(content.getvalue())
    >>> len(content.getvalue()) < 2000, len(archive.take("zeros"))
    (True, 1000000)
    >>> archive.take("zeros", most=10**5)
    Traceback (most recent call last):
    zipfile.BadZipFile: 'zeros' is larger than 100000 bytes
    """

    def __init__(self, content: bytes) -> None:
        super().__init__(_InPieces(content))
        self.left = LARGEST

    def take(self, name: str, most: int = LARGEST) -> bytes:
        """Return a member; all that are taken have :data:`LARGEST` bytes together at most."""
        member = self.getinfo(name)
        if member.file_size > min(most, self.left):
            raise zipfile.BadZipFile(f"{name!r} is larger than {min(most, self.left)} bytes")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise zipfile.BadZipFile(f"{name!r} is compressed in an unusual way")
        self.left -= member.file_size
        with self.open(member) as stream:
            return b"".join(iter(partial(stream.read, PIECE), b""))


def read_saved(content: bytes) -> dict[str, Tensor]:
    """Return the named real tensors that ``torch.save`` wrote, in single precision, on the CPU.

    Of a tuple or list of dictionaries, the first one's. Versions of torch before 1.6 wrote no zip;
    the error has the lines that make one of their files.

    Raises:
        Exception: of any kind, if the content is anything else.

    >>> content = io.BytesIO()
    >>> torch.save({"weight": torch.ones(2, 3)[:, 1:]}, content)
    >>> read_saved(content.getvalue())["weight"]
    tensor([[1., 1.],
            [1., 1.]])
    """
    if not content.startswith(b"PK"):
        raise ValueError(
            "if torch before 1.6 wrote it: weights = torch.load(FILE, weights_only=True); "
            "torch.save(weights, FILE)"
        )
    archive, copy = BoundedZip(content), io.BytesIO()
    names = archive.namelist()
    folder = next(name for name in names if name.endswith("/data.pkl")).removesuffix("data.pkl")
    check_operations(archive.take(f"{folder}data.pkl"))
    needed = re.compile(rf"{re.escape(folder)}(data\.pkl|byteorder|version|data/\w+)")
    with zipfile.ZipFile(copy, "w") as plain:  # torch opens what was counted, and nothing else
        for name in filter(needed.fullmatch, {*names}):
            plain.writestr(name, archive.take(name))
    copy.seek(0)
    saved = torch.load(copy, map_location="cpu", weights_only=True)  # noqa: TID251 - checked above
    first = saved[0] if isinstance(saved, list | tuple) else saved
    tensors = {name: x for name, x in first.items() if isinstance(x, Tensor)}
    total = sum(4 * math.prod(x.shape) for x in tensors.values())  # one number may stand often
    if total > LARGEST:
        raise ValueError("more numbers than a file may hold")
    return {name: x.float() for name, x in tensors.items() if isinstance(name, str)}


def check_operations(pickled: bytes) -> None:
    """Check that a pickle describes tensors in names, and that nothing but a name stands twice.

    Else a hundred bytes could ask for gigabytes, or for pairs of pairs with 2^100 leaves.

    Raises:
        ValueError: for what it asks.
    """
    names, newest = set(), ""
    for count, (operation, value, _) in enumerate(pickletools.genops(pickled)):
        kind = operation.name
        if count == OPERATIONS:
            raise ValueError(f"it asks for more than {OPERATIONS} operations")
        if (kind == "GLOBAL" and value not in ASKED) or (kind == "PROTO" and value != 2):
            raise ValueError(f"it asks for {value!r:.80}")
        if kind.endswith("BINGET") and value not in names:
            raise ValueError("it asks for the same object twice")
        if not kind.endswith("BINPUT"):
            newest = kind
        elif newest in ("GLOBAL", "BINUNICODE"):
            names.add(value)
        else:
            names.discard(value)
