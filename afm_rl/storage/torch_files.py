"""Files of others: members of a zip, and the tensors that ``torch.save`` wrote, in bounds.

Nothing is unpickled. Of a pickle the few operations that describe tensors, and dictionaries, lists
and tuples of them, are followed; whatever else it asks for is refused.
"""

from __future__ import annotations

import io
import math
import pickletools
import zipfile
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import torch
from torch import Tensor

LARGEST = 2**27  # bytes of a file, and of what is taken out of a zip
PIECE = 2**18  # bytes that are read of a zip at once, its table of contents among them
OPERATIONS = 2**18  # of a pickle; a hundred describe a tensor
NUMBERS = {
    "torch FloatStorage": torch.float32,
    "torch DoubleStorage": torch.float64,
    "torch HalfStorage": torch.float16,
    "torch BFloat16Storage": torch.bfloat16,
}


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


class _Saved(NamedTuple):
    """Where the numbers of a tensor are."""

    storage: str
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


def read_saved(content: bytes) -> dict[str, Tensor]:
    """Return the named real tensors that ``torch.save`` wrote, in single precision, on the CPU.

    Of a tuple or list of dictionaries, the first one's. Versions of torch before 1.6 wrote no zip;
    theirs are read, too.

    Raises:
        Exception: of any kind, if the content is anything else.

    >>> content = io.BytesIO()
    >>> torch.save({"weight": torch.ones(2, 3)[:, 1:]}, content)
    >>> read_saved(content.getvalue())["weight"]
    tensor([[1., 1.],
            [1., 1.]])
    """
    kinds: dict[str, str] = {}  # of the storages
    if content.startswith(b"PK"):
        archive = BoundedZip(content)
        names = archive.namelist()
        folder = next(name for name in names if name.endswith("/data.pkl")).removesuffix("data.pkl")
        if f"{folder}byteorder" in names and archive.take(f"{folder}byteorder") != b"little":
            raise ValueError("numbers of another machine")
        saved = _tensors(_described(io.BytesIO(archive.take(f"{folder}data.pkl")), kinds))
        needed = {one.storage for one in saved.values()}
        stored = {name: archive.take(f"{folder}data/{name}") for name in needed}
    else:  # three things about the file, the tensors, names of storages, and these, in order
        stream = io.BytesIO(content)
        *_, described, _ = [_described(stream, kinds) for _ in range(5)]
        saved, stored = _tensors(described), {}
        for name in sorted(kinds):
            size = NUMBERS[kinds[name]].itemsize * int.from_bytes(stream.read(8), "little")
            stored[name] = stream.read(size)
    numbers = {
        name: torch.frombuffer(bytearray(part), dtype=NUMBERS[kinds[name]]).float()
        for name, part in stored.items()
    }
    for name, one in saved.items():
        if math.prod(one.size) > len(numbers[one.storage]):
            raise ValueError(f"{name}: more numbers than there are")
    return {
        name: numbers[one.storage].as_strided(one.size, one.stride, one.offset)
        for name, one in saved.items()
    }


def _tensors(described: Any) -> dict[str, _Saved]:
    """Return the tensors of a dictionary, the first one of several."""
    named = described[0] if isinstance(described, list | tuple) else described
    return {name: x for name, x in named.items() if isinstance(x, _Saved) and isinstance(name, str)}


def _described(stream: io.BytesIO, kinds: dict[str, str]) -> Any:
    """Follow a pickle up to its end; ``kinds`` gets those of the storages that it names."""
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[Any, Any] = {}

    def newest(count: int) -> list[Any]:
        items = stack[len(stack) - count :]
        del stack[len(stack) - count :]
        return items

    def since_mark() -> list[Any]:
        return newest(len(stack) - marks.pop())

    for operation, value, _ in islice(pickletools.genops(stream), OPERATIONS):
        match operation.name:
            case "PROTO":
                pass
            case "MARK":
                marks.append(len(stack))
            case "GLOBAL" | "BINUNICODE" | "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT":
                stack.append(value)
            case "NONE" | "NEWTRUE" | "NEWFALSE":
                stack.append(None)  # of no meaning here
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_TUPLE":
                stack.append(())
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(newest(int(operation.name[-1]))))
            case "TUPLE":
                stack.append(tuple(since_mark()))
            case "APPENDS":
                items = since_mark()
                stack[-1].extend(items)
            case "SETITEM" | "SETITEMS":
                items = newest(2) if operation.name == "SETITEM" else since_mark()
                if not all(isinstance(name, str | int) for name in items[::2]):
                    raise ValueError("a name that is no text")  # tuples may take for ever to hash
                stack[-1].update(zip(items[::2], items[1::2], strict=True))
            case "BINPUT" | "LONG_BINPUT":
                memo[value] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[value])
            case "BINPERSID":
                match stack.pop():
                    case ("storage", str(kind), str(name), *_):
                        kinds[name] = kind
                        stack.append(name)
                    case _:
                        raise ValueError("numbers that are nowhere")
            case "REDUCE":
                match newest(2):
                    case ["torch._utils _rebuild_tensor_v2", (str(), int(), *shape) as given] if (
                        all(isinstance(x, int) for part in shape[:2] for x in part)
                    ):
                        stack.append(_Saved(*given[:4]))
                    case ["collections OrderedDict", ()]:
                        stack.append({})
                    case [made, _]:
                        raise ValueError(
                            f"it asks for {made if isinstance(made, str) else '?':.80}"
                        )
            case "BUILD":
                stack.pop()  # versions of layers
            case "STOP":
                return stack.pop()
            case name:
                raise ValueError(f"it asks for {name}")
    raise ValueError("it does not end")
