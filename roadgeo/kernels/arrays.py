"""Arrays of kernels by type and number of dimensions, all C-contiguous, and the meaning of annotations to kernels."""

from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

Floats1: TypeAlias = Annotated[NDArray[np.float64], 1]
Floats2: TypeAlias = Annotated[NDArray[np.float64], 2]
Floats3: TypeAlias = Annotated[NDArray[np.float64], 3]
Singles1: TypeAlias = Annotated[NDArray[np.float32], 1]
Singles2: TypeAlias = Annotated[NDArray[np.float32], 2]
Ints1: TypeAlias = Annotated[NDArray[np.int64], 1]
Ints2: TypeAlias = Annotated[NDArray[np.int64], 2]
Ints3: TypeAlias = Annotated[NDArray[np.int64], 3]
Int32s1: TypeAlias = Annotated[NDArray[np.int32], 1]
Int32s2: TypeAlias = Annotated[NDArray[np.int32], 2]
Int8s2: TypeAlias = Annotated[NDArray[np.int8], 2]
Int8s3: TypeAlias = Annotated[NDArray[np.int8], 3]
Bytes2: TypeAlias = Annotated[NDArray[np.uint8], 2]
UInt64s1: TypeAlias = Annotated[NDArray[np.uint64], 1]
UInt64s2: TypeAlias = Annotated[NDArray[np.uint64], 2]
Words3: TypeAlias = Annotated[NDArray[np.uint16], 3]
Bools1: TypeAlias = Annotated[NDArray[np.bool_], 1]
Bools2: TypeAlias = Annotated[NDArray[np.bool_], 2]


@dataclass(frozen=True)
class ArrayKind:
    """A C-contiguous array, which a kernel writes to or only reads."""

    dtype: np.dtype[Any]
    ndim: int
    written: bool = False

    def __str__(self) -> str:
        return f"{self.dtype} array of {self.ndim} dimensions"


@dataclass(frozen=True)
class TupleKind:
    """A tuple; `named` is its class where that is a NamedTuple."""

    members: tuple["Kind", ...]
    named: Any = None


#: float, int, bool or None (nothing) stand for themselves.
Kind: TypeAlias = ArrayKind | TupleKind | type[float] | type[int] | type[bool] | None


def kind_of(annotation: Any, written: bool = False) -> Kind:
    """Return the kind of value that an annotation describes; `written` marks arrays that the kernel writes to.

    Raises
    ------
    TypeError
        It is incomplete, such as an array without its number of dimensions.
    """
    if annotation in (float, int, bool, None):
        return annotation  # type: ignore[no-any-return]
    if get_origin(annotation) is Annotated:
        array, ndim = get_args(annotation)
        given = get_args(array)  # from the alias `NDArray[scalar]`, or from its expansion in older NumPy
        return ArrayKind(np.dtype(given[0] if len(given) == 1 else get_args(given[1])[0]), ndim, written)
    if get_origin(annotation) is tuple:
        return TupleKind(tuple(kind_of(member, written) for member in get_args(annotation)))
    if hasattr(annotation, "_fields"):
        hints = get_type_hints(annotation, include_extras=True)
        return TupleKind(tuple(kind_of(hints[name], written) for name in annotation._fields), annotation)
    raise TypeError(f"{annotation} is no type of a kernel's argument")


def leaves(*kinds: Kind) -> list[Kind]:
    """Return the arrays and numbers that kinds consist of."""
    found: list[Kind] = []
    for kind in kinds:
        found += leaves(*kind.members) if isinstance(kind, TupleKind) else [kind] * (kind is not None)
    return found
