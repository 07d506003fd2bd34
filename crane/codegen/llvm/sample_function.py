"""Functions of one sample in machine code that Python calls directly, without ctypes.

    PyObject *sample_function(PyObject *self, PyObject *const *arguments, Py_ssize_t count)

is compiled once for all routines (calling convention METH_FASTCALL). The addresses that it needs,
of Python, NumPy and the routine, are in the array `self`, because machine code is cached between
processes. It creates the result, copies the arguments to the inputs of the routine, calls it, and
copies its output. From the first copy to the last it holds the global interpreter lock, so that
calls of threads that share a function do not mix.
"""

import ctypes
import functools
import sys
from collections.abc import Callable
from struct import pack
from typing import Any

import numpy as np
from numpy._core._multiarray_umath import _ARRAY_API  # type: ignore[import-not-found]
from numpy.typing import NDArray

from crane.codegen.llvm.machine_code import MachineCode
from crane.common.samples import Array

SampleFunction = Callable[..., Array | None]

_FIELDS = {  # of the data of `self`
    "array_type": "ptr",
    "double": "i64",  # kind, byte order and number of the data type
    "none": "ptr",
    "new_array": "ptr",
    "increment": "ptr",
    "decrement": "ptr",
    "routine": "ptr",
    "routine_arguments": "ptr",
    "inputs": "ptr",
    "max_count": "i64",
    "length": "i64",
    "output": "ptr",
    "output_bytes": "i64",
    "dimensions": "ptr",
    "dimension_count": "i64",
}
# METH_FASTCALL in Python's methodobject.h, PyArray_New in the table of NumPy's functions
_FASTCALL, _PYARRAY_NEW = 0x0080, 93
_OBJECT_SIZE = 16  # [bytes] of a PyObject; larger where Python has no global interpreter lock
_DTYPE_NUMBERS = 24  # [bytes] offset of `kind` in a PyArray_Descr
_EXTRACTIONS = "\n".join(
    f"  %{name} = extractvalue %FunctionData %fields, {i}" for i, name in enumerate(_FIELDS)
)
# ArrayObject: reference count, type, data, nd, padding, dimensions, strides, base, descr;
# Descr: reference count, type, typeobj, then kind, type, byteorder, flags and type_num
_TEXT = f"""
%ArrayObject = type {{ i64, ptr, ptr, i32, i32, ptr, ptr, ptr, ptr }}
%Descr = type {{ i64, ptr, ptr, i64 }}
%FunctionData = type {{ {", ".join(_FIELDS.values())} }}
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
define ptr @sample_function(ptr %self, ptr %arguments, i64 %count) {{
  %self_data = getelementptr %ArrayObject, ptr %self, i64 0, i32 2
  %data = load ptr, ptr %self_data
  %fields = load %FunctionData, ptr %data
{_EXTRACTIONS}
  %fits = icmp ule i64 %count, %max_count
  br i1 %fits, label %create, label %refuse
create:
  %nd = trunc i64 %dimension_count to i32
  %out = call ptr %new_array(ptr %array_type, i32 %nd, ptr %dimensions, i32 {np.dtype(float).num},
    ptr null, ptr null, i32 0, i32 0, ptr null)
  %failed = icmp eq ptr %out, null
  br i1 %failed, label %end, label %each_argument
each_argument:
  %i = phi i64 [ 0, %create ], [ %next_i, %next ]
  %is_argument = icmp ult i64 %i, %count
  br i1 %is_argument, label %check_type, label %compute
check_type:
  %argument_pointer = getelementptr ptr, ptr %arguments, i64 %i
  %argument = load ptr, ptr %argument_pointer
  %type_pointer = getelementptr %ArrayObject, ptr %argument, i64 0, i32 1
  %type = load ptr, ptr %type_pointer
  %is_array = icmp eq ptr %type, %array_type
  br i1 %is_array, label %check_dtype, label %discard
check_dtype:
  %array = load %ArrayObject, ptr %argument
  %dtype = extractvalue %ArrayObject %array, 8
  %numbers_pointer = getelementptr %Descr, ptr %dtype, i64 0, i32 3
  %numbers = load i64, ptr %numbers_pointer
  %is_double = icmp eq i64 %numbers, %double
  %ndim = extractvalue %ArrayObject %array, 3
  %is_vector = icmp eq i32 %ndim, 1
  %is_double_vector = and i1 %is_double, %is_vector
  br i1 %is_double_vector, label %check_length, label %discard
check_length:
  %shape = extractvalue %ArrayObject %array, 5
  %size = load i64, ptr %shape
  %strides = extractvalue %ArrayObject %array, 6
  %stride = load i64, ptr %strides
  %source = extractvalue %ArrayObject %array, 2
  %row_start = mul i64 %i, %length
  %row = getelementptr double, ptr %inputs, i64 %row_start
  %is_sample = icmp eq i64 %size, %length
  br i1 %is_sample, label %each_number, label %discard
each_number:
  %j = phi i64 [ 0, %check_length ], [ %next_j, %copy ]
  %is_number = icmp ult i64 %j, %length
  br i1 %is_number, label %copy, label %next
copy:
  %offset = mul i64 %j, %stride
  %from = getelementptr i8, ptr %source, i64 %offset
  %number = load double, ptr %from, align 1
  %to = getelementptr double, ptr %row, i64 %j
  store double %number, ptr %to
  %zero = fsub double %number, %number
  %is_finite = fcmp oeq double %zero, 0.0
  %next_j = add i64 %j, 1
  br i1 %is_finite, label %each_number, label %discard
next:
  %next_i = add i64 %i, 1
  br label %each_argument
compute:
  %done = call i64 %routine(ptr %routine_arguments)
  %is_done = icmp eq i64 %done, 1
  br i1 %is_done, label %finish, label %discard
finish:
  %out_pointer = getelementptr %ArrayObject, ptr %out, i64 0, i32 2
  %out_data = load ptr, ptr %out_pointer
  call void @llvm.memcpy.p0.p0.i64(ptr %out_data, ptr %output, i64 %output_bytes, i1 false)
  br label %end
end:
  ret ptr %out
discard:
  call void %decrement(ptr %out)
  br label %refuse
refuse:
  call void %increment(ptr %none)
  ret ptr %none
}}
"""


def make_sample_function(
    routine: Any, routine_arguments: NDArray[np.int64], inputs: Array, output: Array, *owners: Any
) -> SampleFunction:
    """A function of one sample around a routine; see `Program.sample_function`.

    Args:
        routine: Entry point of the routine, see `MachineCode.entry_point`.
        routine_arguments: Arguments of the routine.
        inputs: (k, n) array that it reads.
        output: Array that it writes.
        owners: What else the function keeps alive.
    """
    if sys.implementation.name != "cpython" or object.__basicsize__ != _OBJECT_SIZE:
        return lambda *_: None
    dimensions = np.array(output.shape, dtype=np.int64)
    shared_fields, method, _ = shared = _shared_parts()
    fields = [
        *shared_fields,
        ctypes.cast(routine, ctypes.c_void_p).value,
        routine_arguments.ctypes.data,
        inputs.ctypes.data,
        *inputs.shape,
        output.ctypes.data,
        output.nbytes,
        dimensions.ctypes.data,
        output.ndim,
    ]
    kind = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, *[ctypes.py_object] * 2)
    create: Callable[..., SampleFunction] = kind(("PyCFunction_NewEx", ctypes.pythonapi))
    return create(
        ctypes.addressof(method),
        np.array(fields, dtype=np.int64),
        # these become the attribute `__module__`, which may be anything, and live as long
        (shared, routine_arguments, inputs, output, dimensions, owners),
    )


@functools.cache
def _shared_parts() -> tuple[list[int | None], "ctypes.Array[ctypes.c_char]", Any]:
    """What all functions share: the first fields, the PyMethodDef, and what it refers to."""
    code, name = MachineCode.compile_text(_TEXT), ctypes.create_string_buffer(b"sample_function")
    address = code.function_address("sample_function")
    method = ctypes.create_string_buffer(
        pack("PPiP", ctypes.addressof(name), address, _FASTCALL, 0)
    )
    kind = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_void_p)
    table = kind(("PyCapsule_GetPointer", ctypes.pythonapi))(_ARRAY_API, None)
    fields = [
        id(np.ndarray),
        ctypes.c_int64.from_address(id(np.dtype(np.float64)) + _DTYPE_NUMBERS).value,
        id(None),
        ctypes.c_int64.from_address(table + 8 * _PYARRAY_NEW).value,
        ctypes.cast(ctypes.pythonapi.Py_IncRef, ctypes.c_void_p).value,
        ctypes.cast(ctypes.pythonapi.Py_DecRef, ctypes.c_void_p).value,
    ]
    return fields, method, (code, name)
