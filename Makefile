# DAR: build, test, measure.  `make help` lists the targets.
#
#   MODE=release|debug|asan    one folder each: build/$(MODE); nothing is written elsewhere
#   CC=gcc|clang               both build without a warning
#
# Binaries are portable: files named *_avx2.c, *_avx512.c are compiled for those instructions and called only
# where the processor has them.

MODE ?= release
B    := build/$(MODE)

CSTD   := -std=c11 -D_GNU_SOURCE -I. $(addprefix -isystem /usr/include/,cjson hdf5/serial OpenEXR Imath)
WARN   := -Wall -Wextra -Wpedantic -Wshadow -Wvla -Wstrict-prototypes -Wmissing-prototypes -Werror
NUM    := -ffp-contract=off -fno-math-errno -fno-trapping-math
OMP    := -fopenmp
OPT_release := -O3 -g
OPT_debug   := -O0 -g3
OPT_fuzz    := -O1 -g -fsanitize=fuzzer-no-link,address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer
OPT_asan    := -O1 -g -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all -fno-omit-frame-pointer
CFLAGS += $(CSTD) $(WARN) $(NUM) $(OMP) $(OPT_$(MODE))

# The openmp flavour of OpenBLAS shares our thread pool; the default alternative (pthread) fights it.
BLAS_DIR := $(firstword $(wildcard /usr/lib/*/openblas-openmp) /usr/lib)
LDFLAGS  += $(OMP) $(filter -fsanitize=%,$(OPT_$(MODE))) -L$(BLAS_DIR) -Wl,-rpath,$(BLAS_DIR)
LIBS     := -lopenblas -lcjson -lmeshoptimizer -lpng -ljpeg -lhdf5_serial -lOpenEXRCore -ldeflate -lcrypto -lm

# Instruction sets per file, read by the one compile rule.
AVX2   := -mavx2 -mfma -mf16c
AVX512 := $(AVX2) -mavx512f -mavx512bw -mavx512vl -mavx512dq -mprefer-vector-width=512
isa     = $(if $(filter %_avx2,$1),$(AVX2)) $(if $(filter %_avx512,$1),$(AVX512)) \
          $(if $(filter %_bf16,$1),$(AVX512) -mavx512bf16) $(if $(filter %_vnni,$1),$(AVX512) -mavx512vnni)

# A fuzz target is called by the fuzzer under this one name; in a test, where all of them are linked, by its file's.
alias   = $(if $(filter-out fuzz,$(MODE)),$(if $(filter tests/fuzz_%,$1),-DLLVMFuzzerTestOneInput=$(notdir $1)))

ROOMS := lib autograd autograd/ops models data train infer

# A program dar-NAME is ROOM/dar_NAME.c with its main, ROOM/dar_NAME_*.c and the library.
HALLS    := data train infer
MAINS    := $(wildcard $(addsuffix /dar_*.c,$(HALLS)))
PROGRAMS := $(sort $(foreach m,$(MAINS),dar-$(word 2,$(subst _, ,$(basename $(notdir $m))))))
parts     = $(patsubst %.c,$B/%.o,$(wildcard $(addsuffix /dar_$1.c,$(HALLS)) $(addsuffix /dar_$1_*.c,$(HALLS))))

SRC   := $(filter-out $(MAINS),$(wildcard $(addsuffix /*.c,$(ROOMS))))
OBJ   := $(SRC:%.c=$B/%.o)
TESTS := $(patsubst tests/%.c,%,$(wildcard tests/test_*.c))
BENCH := $(patsubst %.c,$B/%.o,$(wildcard tests/bench_*.c))
SPEED := $(patsubst tests/%.c,%,$(wildcard tests/speed_*.c))
FUZZ  := $(patsubst tests/%.c,%,$(wildcard tests/fuzz_*.c))

HDR   := $(wildcard $(addsuffix /*.h,$(ROOMS) tests))

.PHONY: all install everything headers test test-built check lint stress bench-kernels bench-dit bench-vae bench-weights
.PHONY: bench bench-data bench-train demo pretrain sweep ulp fuzz fuzz-run
.PHONY: deps clean help FORCE
.DELETE_ON_ERROR:
.SECONDARY:
all: $B/libdar.a $(PROGRAMS:%=$B/%) ## build the library and the programs

help: ## this list
	@awk -F':.*## ' '/^[a-z-]+:.*## /{printf "  make %-14s %s\n", $$1, $$2}' Makefile
	@echo "  MODE=release|debug|asan, CC=gcc|clang"
	@echo "  bench-kernels: QUICK=1, FILTER=text, CPU=none|avx2|avx512|bf16|vnni"

deps: ## install the Debian packages that are missing
	@scripts/install-deps.sh

# ---------------------------------------------------------------- compile
$B/%.o: %.c $B/flags
	@mkdir -p $(@D)
	@echo "CC $<"
	@$(CC) $(CFLAGS) $(call isa,$*) $(call alias,$*) -MMD -MP -c -o $@ $<

$B/flags: FORCE
	@mkdir -p $(@D)
	@echo '$(CC) $(CFLAGS) $(LDFLAGS)' | cmp -s - $@ || echo '$(CC) $(CFLAGS) $(LDFLAGS)' > $@

$B/libdar.a: $(OBJ)
	@rm -f $@
	@ar rcs $@ $^

$(foreach p,$(PROGRAMS),$(eval $B/$p: $(call parts,$(p:dar-%=%))))
$(PROGRAMS:%=$B/%): $B/libdar.a
	@echo "LD $@"
	@$(CC) -o $@ $(filter %.o,$^) $(filter %.a,$^) $(LDFLAGS) $(LIBS)

PREFIX ?= /usr/local
install: all ## copy the programs to PREFIX/bin, PREFIX=/usr/local
	@install -d $(DESTDIR)$(PREFIX)/bin
	@install -m 755 $(PROGRAMS:%=$B/%) $(DESTDIR)$(PREFIX)/bin
	@echo "installed in $(DESTDIR)$(PREFIX)/bin: $(PROGRAMS)"

-include $(wildcard $B/*/*.d $B/*/*/*.d)

# ---------------------------------------------------------------- test
comma := ,
WRAP_test_tape := $(addprefix -Wl$(comma)--wrap=,malloc calloc realloc aligned_alloc posix_memalign mmap)

$B/test_%: $B/tests/test_%.o $B/libdar.a
	@echo "LD $@"
	@$(CC) -o $@ $(filter %.o,$^) $(filter %.a,$^) $(LDFLAGS) $(WRAP_$(@F)) $(LIBS) -lcmocka

$B/test_corpus: $(FUZZ:%=$B/tests/%.o)

$B/test_config $B/test_dit $B/test_adapter $B/test_lora $B/test_scene $B/test_step $B/test_load \
$B/test_sampler $B/test_checkpoint $B/test_train_step: $B/tests/model.o

test: deps ## install what is missing, build, run every test; the last line counts them
	@$(MAKE) --no-print-directory test-built

# Two tests want the real models that may lie beside the repository.
test-built: $(TESTS:%=$B/%) $(PROGRAMS:%=$B/%)
	@EXPECTED_SKIPS=$(if $(wildcard ../shared/assets/robot.glb),0,3) scripts/run-tests.sh $B $(TESTS)

$B/bench_kernels: $(BENCH)
$B/ulp: $B/tests/ulp.o
$B/bench_kernels $B/ulp: $B/libdar.a
	@echo "LD $@"
	@$(CC) -o $@ $(filter %.o,$^) $B/libdar.a $(LDFLAGS) $(LIBS)

# OpenBLAS, the yardstick, runs as it chooses by itself.  Threads stay on their processors: two on one would count as
# slow.
bench-kernels: deps ## speed of every kernel as a fraction of the machine's peak: table, build/bench/kernels.csv
	@$(MAKE) --no-print-directory $B/bench_kernels
	@mkdir -p build/bench
	@env -u OPENBLAS_CORETYPE -u OPENBLAS_L2_SIZE OMP_PROC_BIND=true OMP_PLACES=threads \
		$B/bench_kernels --output=build/bench/kernels.csv \
		$(if $(QUICK),--quick) $(if $(FILTER),'--filter=$(FILTER)') $(if $(CPU),--cpu-mask=$(CPU))

$B/speed_%: $B/tests/speed_%.o $B/tests/rate.o $B/tests/bench_peak.o $B/libdar.a
	@echo "LD $@"
	@$(CC) -o $@ $(filter %.o,$^) $(filter %.a,$^) $(LDFLAGS) $(LIBS) -lcmocka

$B/speed_sample: $B/tests/work_scene.o $B/tests/work_held.o
$B/speed_sample $B/test_front: $B/tests/work_table.o $B/tests/work_report.o $B/infer/dar_eval_html.o

# The front is the model's own where nothing else is asked for.
MODEL := models/dar-tiny
bench: deps ## run time against error: build/bench/work_precision.html, pareto.json; MODEL=DIR, QUICK=1
	@$(MAKE) --no-print-directory $B/speed_sample
	@mkdir -p build/bench
	@OMP_PROC_BIND=true OMP_PLACES=threads $B/speed_sample --model $(MODEL) $(if $(QUICK),--quick --scenes 3 \
		--rounds 1 --fine 60 -o build/bench/quick,--front $(MODEL)/front.json) $(ARGS)

bench-data: deps ## scenes to G-buffers and bundles, stage by stage, against bars: build/bench/data.csv
	@$(MAKE) --no-print-directory $B/speed_data
	@mkdir -p build/bench
	@OMP_PROC_BIND=true OMP_PLACES=threads $B/speed_data --output=build/bench/data.csv

bench-dit bench-vae bench-train: bench-%: deps
	@$(MAKE) --no-print-directory $B/speed_$*
	@OMP_PROC_BIND=true OMP_PLACES=threads $B/speed_$* $(ARGS)
bench-dit: ## the 5B network with random weights: one evaluation; 13 GB, minutes; ARGS="--layers 4 --rank 16"
bench-vae: ## its autoencoder: 9 frames encoded and decoded; 4 GB, minutes; ARGS="--frames 1"
bench-train: ## a training step of dar-tiny: seconds by stage, rate, memory; ARGS="--precision f32"

WEIGHTS := build/bench/wan22-fun-5b.safetensors
bench-weights: ## a file of random weights of the 5B network, 10.6 GB; bench-dit ARGS="--weights FILE" loads it
	@$(MAKE) --no-print-directory $B/speed_dit
	@mkdir -p $(dir $(WEIGHTS))
	@$B/speed_dit --write $(WEIGHTS)

# ---------------------------------------------------------------- the small model
JOBS := $(shell nproc)

demo: deps ## scenes rendered, trained on, measured with the shipped weights; MESH=file.glb REFERENCE=picture.png
	@$(MAKE) --no-print-directory -j$(JOBS) all
	@MESH='$(MESH)' REFERENCE='$(REFERENCE)' BIN=$B scripts/demo.sh

pretrain: deps ## the weights of models/dar-tiny from nothing, seeded, some 3 hours; cut it and it goes on
	@$(MAKE) --no-print-directory -j$(JOBS) all
	@BIN=$B scripts/pretrain.sh

sweep: deps ## the paper's ablation, SCALE=smoke|small|paper, SETS="dar depth": out/sweep/SCALE; cut it and it goes on
	@$(MAKE) --no-print-directory -j$(JOBS) all
	@$(if $(SCALE),SCALE='$(SCALE)') $(if $(SETS),SETS='$(SETS)') BIN=$B scripts/sweep.sh

everything: all $(TESTS:%=$B/%) $B/bench_kernels $(SPEED:%=$B/%) $B/ulp

headers: $(HDR:%=alone/%)

alone/%:
	@echo '#include "$*"' | $(CC) $(CFLAGS) -fsyntax-only -x c -

lint: ## the quick half of check: layers, style, format, headers alone
	@scripts/check.sh static

check: ## lint, then gcc, clang, debug and sanitizer builds, tests in release and under sanitizers
	@scripts/check.sh

stress: deps ## where numbers break, with tests that take gigabytes of memory; training killed 200 times, and long
	@$(MAKE) --no-print-directory all $B/test_stress $B/test_kill
	@$B/test_stress full
	@$B/test_kill full

ulp: ## exp, tanh, rsqrt, silu at all 2^32 arguments against f64, at every CPU level; a few minutes
	@$(MAKE) --no-print-directory $B/ulp
	@$B/ulp

$B/fuzz_%: $B/tests/fuzz_%.o $B/libdar.a
	@echo "LD $@"
	@$(CC) -fsanitize=fuzzer -o $@ $^ $(LDFLAGS) $(LIBS)

# What a fuzzer finds stays in build/fuzz; the corpora are made by hand and by scripts/make-fixtures.py.
SECONDS := 60
fuzz: ## every parser against damaged input, SECONDS=60 each; needs clang
	@scripts/install-deps.sh check
	@$(MAKE) --no-print-directory CC=clang MODE=fuzz fuzz-run

fuzz-run: $(FUZZ:%=$B/%)
	@for f in $(FUZZ:fuzz_%=%); do \
		mkdir -p $B/found/$$f; \
		$B/fuzz_$$f -max_total_time=$(SECONDS) -max_len=4096 -timeout=5 -print_final_stats=1 \
			-artifact_prefix=$B/$$f- $B/found/$$f tests/corpus/$$f >$B/$$f.log 2>&1 || { \
			tail -60 $B/$$f.log; exit 1; }; \
		awk -v f=fuzz_$$f '/^stat::number/ { print f ": " $$2 " inputs, no fault" }' $B/$$f.log; \
	done

clean: ## remove build/
	rm -rf build
