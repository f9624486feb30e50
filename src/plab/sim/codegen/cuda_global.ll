; Additions to numbers in global memory whose former values nobody asks for, and a look at one that others change.
; Arguments point to local variables: an address, and what is added there or found.

target triple = "nvptx64-nvidia-cuda"

define void @atomics_add_f32(i64* %where, float* %what) alwaysinline {
  %place = load i64, i64* %where
  %number = load float, float* %what
  %address = inttoptr i64 %place to float addrspace(1)*
  %former = atomicrmw fadd float addrspace(1)* %address, float %number monotonic
  ret void
}

define void @atomics_add_f64(i64* %where, double* %what) alwaysinline {
  %place = load i64, i64* %where
  %number = load double, double* %what
  %address = inttoptr i64 %place to double addrspace(1)*
  %former = atomicrmw fadd double addrspace(1)* %address, double %number monotonic
  ret void
}

define void @atomics_look_i32(i64* %where, i32* %what) alwaysinline {
  %place = load i64, i64* %where
  %address = inttoptr i64 %place to i32 addrspace(1)*
  %number = load volatile i32, i32 addrspace(1)* %address
  store i32 %number, i32* %what
  ret void
}

define void @atomics_add_i64(i64* %where, i64* %what) alwaysinline {
  %place = load i64, i64* %where
  %number = load i64, i64* %what
  %address = inttoptr i64 %place to i64 addrspace(1)*
  %former = atomicrmw add i64 addrspace(1)* %address, i64 %number monotonic
  ret void
}
