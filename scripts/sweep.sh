#!/bin/sh
# sweep.sh: the paper's ablation: every channel set trained on one backbone, with the same data, steps and seed, kept at
# fifths of its steps; rendered and measured on five sets of scenes that were not in training; the paper's tables.  Cut
# it at any moment and start it again: what is done is kept.
#
#   SCALE=smoke   whether all of it works: a quarter of an hour
#         small   models/dar-tiny: four hours
#         paper   the 5B network: configurations, memory and time of each; trained only where WEIGHTS and memory are
#   SETS="dar depth dar:full"    channel sets (data/condition.h), :full trains all of the network
#   SEEDS="0 1 2"   KEYS="condition.geometry_frame=scene"   with OUT of their own, or they would be mixed with others
set -eu
SCALE=${SCALE:-small}
BIN=${BIN:-build/release}
MODEL=${MODEL:-models/dar-tiny}
WEIGHTS=${WEIGHTS:-Wan2.2-Fun-5B-Control-Camera}
OUT=${OUT:-out/sweep/$SCALE}
SEEDS=${SEEDS:-0}
KEYS=${KEYS:-}
whole=${SETS:+no}${KEYS:+no}
SETS=${SETS:-camera depth tracking normal world tracking+normal tracking+world normal+world tracking+depth normal+depth
    tracking+normal+depth dar mask+world+normal mask+depth+normal dar:full}
FIFTHS=${FIFTHS:-dar tracking+normal+depth mask+world+normal mask+depth+normal dar:full} # measured at every fifth

# Splits, and how many clips of each; 0: all.  A step of the small model takes about a second on two cores, as does a
# render in 10 steps: 15 trainings are 5 minutes (smoke) or 100 (small), the 3800 renders of small some 70.
case $SCALE in
smoke) steps=20 clips=16 few="4d_vis=4 ood34=2 refvar=2 motion-separation=2 correspondence=2" sample="--steps 4" ;;
small) steps=300 clips=1200 sample="--solver ab2 --steps 10" ;;
paper) steps=10000 clips=1000 sample="--weights $WEIGHTS" ;;
*) echo "sweep: SCALE: found '$SCALE', expected smoke, small or paper" >&2 && exit 2 ;;
esac
STEPS=${STEPS:-$steps}
CLIPS=${CLIPS:-$clips}
SPLITS=${SPLITS:-${few:-4d_vis=0 ood34=0 refvar=0 motion-separation=0 correspondence=0}}
SAMPLE=${SAMPLE:-$sample}
fifth=$((STEPS / 5))
case $SCALE in
paper)
    CONFIGS=${CONFIGS:-$PWD/train/configs/wan22-fun-5b} DATA=${DATA:-$OUT/data} SET=${SET:---size 832x480 --frames 81}
    backbone=wan22-fun-5b weights="\"$WEIGHTS\"" codec="--weights $WEIGHTS" warmup=200
    ;;
*)
    [ "$SCALE" = smoke ] && DATA=${DATA:-$OUT/data}
    CONFIGS=${CONFIGS:-$PWD/train/configs/dar-tiny} DATA=${DATA:-out/data} SET=${SET---coarse}
    backbone=$MODEL/backbone weights=null codec= warmup=$((STEPS / 20))
    ;;
esac

say() {
    printf '\n%s: %s\n' "$(date +%T)" "$*"
}

synth() {
    # shellcheck disable=SC2046,SC2086
    "$BIN/dar-bundle" synth -o "$DATA/$1" --set "$1" $SET $([ "$2" = 0 ] || echo --count "$2")
}

# For every run: CALL NAME SET MODE SEED
each() {
    for run in $SETS; do
        for seed in $SEEDS; do
            set=${run%:full} mode=lora
            [ "$set" = "$run" ] || mode=full
            name=$set
            [ $mode = lora ] || name=$name-full
            [ "$seed" = 0 ] || name=$name-seed$seed
            "$1" "$name" "$set" $mode "$seed"
        done
    done
}

# The configuration of a run, which says all that it is.
configure() {
    base=$2
    [ "$3" = lora ] || base=full
    cat >"$OUT/configs/$1.json" <<END
{
    "base": "$CONFIGS/$base.json",
    "model": "$backbone",
    "weights": $weights,
    "data": ["$DATA/train"],
    "condition": { "channels": "$2" },
    "seed": $4,
    "max_train_steps": $STEPS,
    "checkpointing_steps": $fifth,
    "checkpoints_total_limit": 5,
    "lr_warmup_steps": $warmup,
    "validation": { "data": [] },
    "output_dir": "$OUT/runs/$1"
}
END
}

train() {
    name=$1
    [ ! -d "$OUT/runs/$name/checkpoint-$STEPS" ] || return 0
    say "train $name"
    shift 4
    for key in $KEYS; do set -- "$@" --set "$key"; done
    "$BIN/dar-train" "$OUT/configs/$name.json" --resume auto "$@"
}

# Memory and time of a run; small: it has not as much.
plan() {
    "$BIN/dar-train" "$OUT/configs/$1.json" --dry-run --json >"$OUT/configs/$1.plan"
    awk -v name="$1" -F '[:,]' '
        $1 ~ /"(bytes|budget|seconds|steps)"/ { gsub(/[ "]/, "", $1); x[$1] = $2 }
        END {
            printf "%-28s %6.2f GB of %6.2f, at least %6.1f days\n", name, x["bytes"] / 1e9, x["budget"] / 1e9,
                   x["steps"] * x["seconds"] / 86400
            exit x["bytes"] > x["budget"]
        }' "$OUT/configs/$1.plan" || small=yes
}

# method NAME SET MODE SEED STEP MODEL SPLIT...: videos in OUT/videos/NAME@STEP/SPLIT
method() {
    dir=$OUT/videos/$1@$5 from=$6
    mkdir -p "$dir"
    printf '{ "set": "%s", "mode": "%s", "step": %d, "seed": %d }\n' "$2" "$3" "$5" "$4" >"$dir/method.json"
    shift 6
    for split do
        # shellcheck disable=SC2086
        "$BIN/dar-sample" "$DATA/$split"/0* --model "$from" -o "$dir/$split" $SAMPLE --no-mp4 --no-sheet --quiet \
            >"$dir/$split.txt"
    done
}

render() {
    say "render $1"
    run=$OUT/runs/$1/checkpoint
    case " $FIFTHS " in *" $2 "* | *" $2:$3 "*)
        for k in 1 2 3 4; do method "$1" "$2" "$3" "$4" $((k * fifth)) "$run-$((k * fifth))" 4d_vis; done ;;
    esac
    # shellcheck disable=SC2086
    method "$1" "$2" "$3" "$4" "$STEPS" "$run-$STEPS" $names
}

run() {
    train "$@"
    render "$@"
}

# evaluate NAME SPLIT METHOD...: unless nothing was rendered since; methods of which there is nothing are left out
evaluate() {
    to=$OUT/eval/$1 split=$2
    shift 2
    given=$#
    for dir do
        [ ! -d "$dir/$split" ] || set -- "$@" "$(basename "$dir")=$dir"
    done
    shift "$given"
    base=$(echo " $*" | grep -o " dar@$STEPS=" | tr -d ' =' || true)
    [ -f "$to/report.html" ] && [ -z "$(find "$OUT/videos" -name sample.json -newer "$to/report.html")" ] && return
    say "evaluate $(basename "$to")"
    mkdir -p "$OUT/eval"
    # shellcheck disable=SC2086
    "$BIN/dar-eval" "$@" --against "$DATA/$split" --model "$backbone" $codec --beside infer/paper.csv \
        ${base:+--base "$base"} -o "$to" --overwrite
}

if [ "$SCALE" != paper ] && [ ! -f "$MODEL/backbone/dit.safetensors" ]; then
    echo "sweep: $MODEL has no weights; 'make pretrain' trains them, in some 3 hours on two cores" >&2
    exit 2
fi
mkdir -p "$DATA" "$OUT/configs"
# What was made from other weights, or with other steps, would be mixed with this.
{ echo "$STEPS $KEYS" && cat "$MODEL"/backbone/*.safetensors; } 2>/dev/null | cksum >"$OUT/made-of.new"
if [ -f "$OUT/made-of" ] && ! cmp -s "$OUT/made-of.new" "$OUT/made-of"; then
    echo "sweep: $OUT was made from other weights, or with other steps or keys: remove it, or set OUT" >&2
    exit 2
fi
mv "$OUT/made-of.new" "$OUT/made-of"
small=
each configure
names=
for split in $SPLITS; do names="$names ${split%=*}"; done

if [ "$SCALE" = paper ]; then
    synth train 1
    each plan
    if [ -n "$small" ] || [ ! -e "$WEIGHTS" ]; then
        say "$OUT/configs has what would be trained; it needs that memory, and weights in $WEIGHTS"
        exit 0
    fi
fi

say "scenes"
synth train "$CLIPS"
for split in $SPLITS; do synth "${split%=*}" "${split#*=}"; done
# shellcheck disable=SC2086
method backbone camera none 0 0 "$backbone" $names
each run

for split in $names; do evaluate "$split" "$split" "$OUT"/videos/backbone@0 "$OUT"/videos/*@"$STEPS"; done
set --
for k in 1 2 3 4 5; do set -- "$@" "$OUT"/videos/*@$((k * fifth)); done
evaluate fifths 4d_vis "$@"
cat "$OUT"/eval/*/table.csv | awk '!seen[$0]++' >"$OUT/table.csv"
for split in $names fifths; do cat "$OUT/eval/$split/tables.md"; done >"$OUT/table.md"
cp "$OUT/eval/4d_vis/report.html" "$OUT/eval/4d_vis/sheet.png" "$OUT"
if [ "$SCALE" = small ] && [ -z "$whole" ]; then
    mkdir -p "$MODEL/results"
    cp "$OUT/table.csv" "$OUT/table.md" "$MODEL/results"
fi
say "done"
echo "tables   $OUT/table.md, table.csv"
echo "reports  $OUT/report.html of 4d_vis; $OUT/eval/*/report.html of the others, and of every fifth"
