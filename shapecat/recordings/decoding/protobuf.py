"""Decode Protocol Buffers with the descriptors stored in a recording."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

__all__ = ["message_class", "message_decoder"]


def message_class(descriptors: bytes, name: str) -> Any:
    """Return the class of a message, given a serialized FileDescriptorSet.

    Raises
    ------
    ValueError : the descriptors do not describe the message, or are damaged.
    """
    pool = DescriptorPool()
    try:
        files = {file.name: file for file in FileDescriptorSet.FromString(descriptors).file}
        while files:
            _add(pool, next(iter(files)), files)
        return GetMessageClass(pool.FindMessageTypeByName(name))
    except (DecodeError, KeyError, TypeError) as error:
        msg = f"no descriptor of {name}: {error}"
        raise ValueError(msg) from error


def _add(pool: DescriptorPool, name: str, files: dict[str, Any]) -> None:
    """Move file ``name`` from ``files`` to the pool, after the files that it depends on."""
    file = files.pop(name)
    for needed in file.dependency:
        if needed in files:
            _add(pool, needed, files)
    pool.Add(file)


def message_decoder(descriptors: bytes, name: str) -> Callable[[bytes | memoryview], Any]:
    """Return a decoder for a message, given a serialized FileDescriptorSet.

    Decoded messages have their fields as attributes. An absent field has its default value, an
    absent submessage is None. The decoder raises ValueError for damaged data.

    Raises
    ------
    ValueError : the descriptors do not describe the message, or are damaged.
    """
    kind = message_class(descriptors, name)

    def decode(data: bytes | memoryview) -> Any:
        try:
            return _record(kind.FromString(bytes(data)))
        except DecodeError as error:
            raise ValueError(str(error)) from error

    return decode


def _record(message: Any) -> Any:
    """Return the fields of a message as attributes."""
    return SimpleNamespace(**{f.name: _value(message, f) for f in message.DESCRIPTOR.fields})


def _value(message: Any, field: Any) -> Any:
    value = getattr(message, field.name)
    if field.message_type is None:
        return list(value) if field.is_repeated else value
    if field.message_type.GetOptions().map_entry:
        return dict(value)
    if field.is_repeated:
        return [_record(item) for item in value]
    return _record(value) if message.HasField(field.name) else None
