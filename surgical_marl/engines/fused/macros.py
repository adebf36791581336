"""The macros of printed code: scalars for CUDA, vectors of environments for Clang.

Division and square root are CUDA's approximate ones, right to two units in the last place. They take numbers below
2^-126 for 0, which saves the scaling of such numbers: one instruction in twenty of a physics step. That division gives
0 for a divisor above 2^126.

`WORK_KEY` is what environments are sorted by: the paths that one took in the first bits, then how much there was to do,
as the exponent and twelve more bits of a float.
`BLOCK_BARRIER` lets the threads of a block wait for each other, to find each other's instructions in the cache.
`GRID_BARRIER` lets all blocks wait for each other too, if there is a multiprocessor for each. Only time depends on it,
so nothing waits longer than `BARRIER_TIMEOUT`: other programs may keep some blocks from running. `arrivals` is a
counter of blocks, which wraps after `ARRIVALS_WRAP` times all, and the number of multiprocessors.
`ALIGNED` arrays begin where four numbers can be moved by one instruction.
`FENCE` is a place past which Clang moves no load and no store.
`HIDEF` makes the C compiler take a register for a new value.
"""

from __future__ import annotations

LANES = 8
"""Environments in a vector on a CPU: 32 bytes of float32, an AVX register, and what `gatherd_d256` loads at once."""
LONG_CODE = 8
"""So many large branches make code long: all threads of a block should be at the same place of it."""
WORK_BITS = 17
"""Of `work`, for how much there was to do."""
PATHS = 31 - WORK_BITS
"""Most paths that are told apart: the other bits of an int32, but for its sign."""
WORK_MASK = 2**WORK_BITS - 1
"""The bits of `work` that say how much there was to do."""
BARRIER_TIMEOUT = 2_000_000
"""Cycles, about 1 ms: a physics step of any group of 32 takes less."""
ARRIVALS_WRAP = 2**20
"""Times that all blocks come by until they are counted from 0 again."""
MOST_THREADS = 64
"""So many threads in a block at most wait for other blocks. More of them keep a multiprocessor busy while some wait."""


def is_long(large_branches: int) -> bool:
    """Return whether code with so many large branches is long: it matters which of it neighbours run at a time."""
    return large_branches >= LONG_CODE


_WORK_KEY = f"""
#define WORK_KEY ((paths_<<SPLATI({WORK_BITS}))|MAXI(U2I(BITS(I2F(work_))>>SPLATU(11))-SPLATI(520192),SPLATI(0)))
"""  # 520192 is what it would be for a work of 1
CUDA = (
    f"""
enum {{ MOST_THREADS = {MOST_THREADS}, BARRIER_TIMEOUT = {BARRIER_TIMEOUT}, ARRIVALS_WRAP = {ARRIVALS_WRAP} }};
"""
    """
typedef float F; typedef int I; typedef unsigned int U; typedef bool B;
#define ALIGNED alignas(16)
#define SM_INF __int_as_float(0x7f800000)
#define SM_NAN __int_as_float(0x7fffffff)
#define ANY(c) (c)
#define NOT(c) (!(c))
#define SELECT(c,a,b) ((c)?(a):(b))
#define SPLAT(x) (x)
#define SPLATI(x) (x)
#define SPLATU(x) (x)
#define SPLATB(x) ((x)!=0)
#define LDF(p,i) p.data[(size_t)(i)*stride+t]
#define LDI(p,i) p.data[(size_t)(i)*stride+t]
#define LDU(p,i) ((U)p.data[(size_t)(i)*stride+t])
#define LDB(p,i) (p.data[(size_t)(i)*stride+t]!=0)
#define STF(p,i,x) p.data[(size_t)(i)*stride+t]=(x);
#define STI(p,i,x) p.data[(size_t)(i)*stride+t]=(x);
#define STU(p,i,x) p.data[(size_t)(i)*stride+t]=(I)(x);
#define STB(p,i,x) p.data[(size_t)(i)*stride+t]=(x);
#define TABLEF(k,i) reals.data[k+(i)]
#define TABLEI(k,i) wholes.data[k+(i)]
#define ROWF(k,i) reals.data[k+(i)]
#define ROWI(k,i) wholes.data[k+(i)]
#define DIVF(a,b) \
([](float x,float y){float r;asm("div.approx.ftz.f32 %0, %1, %2;":"=f"(r):"f"(x),"f"(y));return r;}(a,b))
#define DIVI(a,b) ((a)/(b))
#define DIVU(a,b) ((a)/(b))
#define REMF(a,b) fmodf(a,b)
#define REMI(a,b) ((a)%(b))
#define REMU(a,b) ((a)%(b))
#define ABSF(x) fabsf(x)
#define ABSI(x) abs(x)
#define SQRT(x) ([](float a){float r;asm("sqrt.approx.ftz.f32 %0, %1;":"=f"(r):"f"(a));return r;}(x))
#define MAXF(a,b) fmaxf(a,b)
#define MINF(a,b) fminf(a,b)
#define MAXI(a,b) max(a,b)
#define MINI(a,b) min(a,b)
#define MAXU(a,b) max(a,b)
#define MINU(a,b) min(a,b)
#define FLOOR floorf
#define CEIL ceilf
#define RINT rintf
#define POW powf
#define LOG logf
#define TAN tanf
#define ACOS acosf
#define ASIN asinf
#define ATAN2 atan2f
#define TANH tanhf
#define FINITE(x) isfinite(x)
#define F2I(x) ((I)(x))
#define F2U(x) ((U)(x))
#define I2F(x) ((F)(x))
#define U2F(x) ((F)(x))
#define I2U(x) ((U)(x))
#define U2I(x) ((I)(x))
#define HIDEF(x) asm volatile("":"+f"(x));
#define HIDEI(x) asm volatile("":"+r"(x));
#define HIDEU(x) asm volatile("":"+r"(x));
#define WORK(n,c) work_+=n;
#define PATH(n,c) paths_|=1<<n;
#define BLOCK_BARRIER __syncthreads();
#define GRID_BARRIER \
    if(gridDim.x<=(U)arrivals.data[1]&&blockDim.x<=MOST_THREADS){ \
        if(threadIdx.x==0){ \
            U*count_=(U*)arrivals.data,n_=atomicInc(count_,gridDim.x*ARRIVALS_WRAP-1),first_=n_/gridDim.x*gridDim.x; \
            long long since_=clock64(); \
            if(n_-first_<gridDim.x-1) \
                while(*(volatile U*)count_-first_<gridDim.x&&clock64()-since_<BARRIER_TIMEOUT); \
        } \
    } \
    BLOCK_BARRIER
#define BITS(x) __float_as_uint(x)
#define FLOAT(x) __uint_as_float(x)
""" + _WORK_KEY
)

CPU = (
    f"""
enum {{ SM_W = {LANES} }};
typedef float F __attribute__((ext_vector_type(SM_W)));
typedef int I __attribute__((ext_vector_type(SM_W)));
typedef unsigned int U __attribute__((ext_vector_type(SM_W)));
typedef int B __attribute__((ext_vector_type(SM_W)));
typedef unsigned char C __attribute__((ext_vector_type(SM_W)));
#define LANE(k,code) {{enum{{l=k}};code}}
#define EACH(code) {"".join(f"LANE({lane},code)" for lane in range(LANES))}
#define LANE_NUMBERS (I{{{",".join(map(str, range(LANES)))}}})
"""
    + """
#define ALIGNED
#define SM_INF __builtin_inff()
#define SM_NAN __builtin_nanf("")
#define ANY(c) (__builtin_reduce_or(c)!=0)
#define NOT(c) (~(c))
#define SELECT(c,a,b) ((c)?(a):(b))
#define SPLAT(x) ((F)(x))
#define SPLATI(x) ((I)(x))
#define SPLATU(x) ((U)(x))
#define SPLATB(x) ((B)(-(x)))
#define SM_AT(p,i) (p.data+(size_t)(i)*stride+t)
#define LDF(p,i) ({F r_;__builtin_memcpy(&r_,SM_AT(p,i),sizeof(F));r_;})
#define LDI(p,i) ({I r_;__builtin_memcpy(&r_,SM_AT(p,i),sizeof(I));r_;})
#define LDU(p,i) ({U r_;__builtin_memcpy(&r_,SM_AT(p,i),sizeof(U));r_;})
#define LDB(p,i) ({C r_;__builtin_memcpy(&r_,SM_AT(p,i),sizeof(C));__builtin_convertvector(r_,B)!=0;})
#define STF(p,i,x) {F r_=(x);__builtin_memcpy(SM_AT(p,i),&r_,sizeof(F));}
#define STI(p,i,x) {I r_=(x);__builtin_memcpy(SM_AT(p,i),&r_,sizeof(I));}
#define STU(p,i,x) {U r_=(x);__builtin_memcpy(SM_AT(p,i),&r_,sizeof(U));}
#define STB(p,i,x) {C r_=__builtin_convertvector((x)&1,C);__builtin_memcpy(SM_AT(p,i),&r_,sizeof(C));}
#define LANEWISE(T,e) ({T r_;EACH(r_[l]=(e);)r_;})
#ifdef __AVX2__
#define GATHER(T,p,i) ((T)__builtin_ia32_gatherd_d256(I{},(const int*)(p),(i),SPLATI(-1),4))
#define TABLEF(k,i) GATHER(F,reals.data+(k),i)
#define TABLEI(k,i) GATHER(I,wholes.data+(k),i)
#define GATHER_ARRAY(T,a,i) GATHER(T,a,(i)*SPLATI(SM_W)+LANE_NUMBERS)
#else
#define TABLEF(k,i) ({I i_=(i);LANEWISE(F,reals.data[k+i_[l]]);})
#define TABLEI(k,i) ({I i_=(i);LANEWISE(I,wholes.data[k+i_[l]]);})
#define GATHER_ARRAY(T,a,i) ({I i_=(i);LANEWISE(T,a[i_[l]][l]);})
#endif
#define ROWF(k,i) SPLAT(reals.data[k+(i)])
#define ROWI(k,i) SPLATI(wholes.data[k+(i)])
#define WITHIN(i,last) __builtin_elementwise_min(__builtin_elementwise_max((I)(i),SPLATI(0)),SPLATI(last))
#define SCATTER_ARRAY(T,a,i,x) {I i_=(i);T r_=(x);EACH(a[i_[l]][l]=r_[l];)}
#define DIVF(a,b) ((a)/(b))
#define DIVI(a,b) ((a)/(b))
#define DIVU(a,b) ((a)/(b))
#define REMF(a,b) ({F a_=(a),b_=(b);LANEWISE(F,wp::mod(a_[l],b_[l]));})
#define REMI(a,b) ((a)%(b))
#define REMU(a,b) ((a)%(b))
#define ABSF(x) __builtin_elementwise_abs(x)
#define ABSI(x) __builtin_elementwise_abs(x)
#define SQRT(x) __builtin_elementwise_sqrt(x)
#define MAXF(a,b) ({F a_=(a),b_=(b);a_>b_?a_:b_;})
#define MINF(a,b) ({F a_=(a),b_=(b);a_<b_?a_:b_;})
#define MAXI(a,b) __builtin_elementwise_max(a,b)
#define MINI(a,b) __builtin_elementwise_min(a,b)
#define MAXU(a,b) __builtin_elementwise_max(a,b)
#define MINU(a,b) __builtin_elementwise_min(a,b)
#define FLOOR(x) __builtin_elementwise_floor(x)
#define CEIL(x) __builtin_elementwise_ceil(x)
#define RINT(x) __builtin_elementwise_roundeven(x)
#define ONE(f,x) ({F a_=(x);LANEWISE(F,wp::f(a_[l]));})
#define TWO(f,x,y) ({F a_=(x),b_=(y);LANEWISE(F,wp::f(a_[l],b_[l]));})
#define POW(a,b) TWO(pow,a,b)
#define LOG(x) ONE(log,x)
#define TAN(x) ONE(tan,x)
#define ACOS(x) ONE(acos,x)
#define ASIN(x) ONE(asin,x)
#define ATAN2(a,b) TWO(atan2,a,b)
#define TANH(x) ONE(tanh,x)
#define FINITE(x) (__builtin_elementwise_abs(x)<(F)SM_INF)
#define F2I(x) __builtin_convertvector(x,I)
#define F2U(x) __builtin_convertvector(x,U)
#define I2F(x) __builtin_convertvector(x,F)
#define U2F(x) __builtin_convertvector(x,F)
#define I2U(x) ((U)(x))
#define U2I(x) ((I)(x))
#define BITS(x) ((U)(x))
#define FLOAT(x) ((F)(x))
#define WORK(n,c) work_+=(c)&SPLATI(n);
#define PATH(n,c) paths_|=(c)&SPLATI(1<<n);
#define FENCE __atomic_signal_fence(__ATOMIC_SEQ_CST);
"""
    + _WORK_KEY
)

MACROS = sorted(
    {line.split("(")[0].split()[1] for code in (CUDA, CPU) for line in code.splitlines() if "#define" in line}
)
UNDEFINE = "\n".join(f"#undef {name}" for name in MACROS)
"""Undefines the macros after the function, so that they don't affect the rest of the program."""
