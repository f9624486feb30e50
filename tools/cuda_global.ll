; Additions to numbers in global memory whose former values nobody asks for. Arguments point to local variables: an
; address, and what is added there.

target triple = "nvptx64-nvidia-cuda"

define void @add_f32(i64* %where, float* %what) alwaysinline {
  %place = load i64, i64* %where
  %number = load float, float* %what
  %address = inttoptr i64 %place to float addrspace(1)*
  %former = atomicrmw fadd float addrspace(1)* %address, float %number monotonic
  ret void
}

define void @add_f64(i64* %where, double* %what) alwaysinline {
  %place = load i64, i64* %where
  %number = load double, double* %what
  %address = inttoptr i64 %place to double addrspace(1)*
  %former = atomicrmw fadd double addrspace(1)* %address, double %number monotonic
  ret void
}

define void @add_i64(i64* %where, i64* %what) alwaysinline {
  %place = load i64, i64* %where
  %number = load i64, i64* %what
  %address = inttoptr i64 %place to i64 addrspace(1)*
  %former = atomicrmw add i64 addrspace(1)* %address, i64 %number monotonic
  ret void
}
