#!/bin/sh
# demo.sh: scenes that were not in training, rendered with the shipped weights from DAR's channels and from rays alone;
# depth, trained here for some hundred steps; additions for one new scene; a report.  MESH=file.glb [REFERENCE=picture]
# renders that mesh instead.  What is done is kept: a second call is quick, one that was interrupted goes on.
set -eu
MODEL=${MODEL:-models/dar-tiny}
CONFIGS=${CONFIGS:-train/configs/dar-tiny}
BIN=${BIN:-build/release}
MESH=${MESH:-} REFERENCE=${REFERENCE:-}
NAME=$(basename "${MESH%.*}")
OUT=${OUT:-out/demo}${MESH:+-$NAME}
SIZE=${SIZE:-224x128}
SET=${SET---coarse}                     # other options of dar-bundle synth, as in pretrain.sh
FRAMES=${FRAMES:-17}
SAMPLE=${SAMPLE:---steps 20}             # options of dar-sample
STEPS=${STEPS:-100}                      # of each training: some 5 minutes in all on two cores
CLIPS=${CLIPS:-48}                       # that depth learns from
COUNT=${COUNT:-32}                       # of the set 4d_vis, 4 camera paths to a scene
SHOWN=${SHOWN:-0 5 10 15 16 21 26 31}    # of these
SCENE=${SCENE:-2}                        # of it three paths are trained on

say() {
    printf '\n%s: %s\n' "$(date +%T)" "$*"
}

bundle() {
    printf '%s/scenes/%06d' "$OUT" "$1"
}

# train CONFIG NAME MODEL DATA KEY=VALUE...: in OUT/train/NAME
train() {
    config=$1 run=$OUT/train/$2 model=$3 data=$4
    shift 4
    for key do
        set -- "$@" --set "$key"
        shift
    done
    "$BIN/dar-train" "$CONFIGS/$config.json" --resume auto --set "model=$model" --set weights=null \
        --set "output_dir=$run" --set "cache_dir=$OUT/train/cache" --set "data=$data" --set "max_train_steps=$STEPS" \
        --set lr_warmup_steps=20 --set "lr_decay_steps=$((STEPS / 2))" --set checkpointing_steps=0 "$@"
}

# sample NAME MODEL BUNDLE...: into OUT/NAME
sample() {
    name=$1 model=$2
    shift 2
    mkdir -p "$(dirname "$OUT/$name")"
    # shellcheck disable=SC2086
    "$BIN/dar-sample" "$@" --model "$model" -o "$OUT/$name" $SAMPLE --overwrite
}

# evaluate DIR ...: unless nothing was rendered since
evaluate() {
    to=$1
    shift
    [ -f "$to/report.html" ] && [ -z "$(find "$OUT" -name sample.json -newer "$to/report.html")" ] && return
    "$BIN/dar-eval" "$@" --model "$MODEL/backbone" -o "$to" --overwrite >"$to.txt"
    cat "$to.txt"
}

finish() {
    cp "$1/report.html" "$1/sheet.png" "$1/metrics.json" "$OUT"
    say "done"
    echo "report         $OUT/report.html"
    echo "contact sheet  $OUT/sheet.png"
}

mesh() {
    say "camera orbit around $MESH"
    bundle=$OUT/scenes/$NAME
    [ -d "$bundle" ] && [ -z "$(find "$MESH" -newer "$bundle")" ] ||
        "$BIN/dar-bundle" render "$MESH" -o "$bundle" --overwrite --size "$SIZE" --frames "$FRAMES" --fps 16 \
            --trajectory orbit-30 --shade day
    say "DAR, and rays alone"
    sample "dar/$NAME" "$MODEL" "$bundle"
    sample "camera/$NAME" "$MODEL/backbone" "$bundle"
    set -- "dar=$OUT/dar" "camera=$OUT/camera"
    if [ -n "$REFERENCE" ]; then
        sample "picture/$NAME" "$MODEL" "$bundle" --reference "$REFERENCE"
        echo '{"name": "your picture", "set": "dar", "external": true}' >"$OUT/picture/method.json"
        set -- "$@" "$OUT/picture"
    fi
    say "report: against the mesh in its own colours"
    evaluate "$OUT/eval" "$@" --against "$bundle"
    finish "$OUT/eval"
    ls "$OUT"/*/"$NAME/video.mp4"
}

scenes() {
    say "scenes that were not in training"
    # shellcheck disable=SC2086
    "$BIN/dar-bundle" synth -o "$OUT/scenes" --set 4d_vis --seed 2026 --count "$COUNT" --size "$SIZE" \
        --frames "$FRAMES" $SET
    shown=
    for k in $SHOWN; do shown="$shown $(bundle "$k")"; done

    say "DAR, and rays alone, with the shipped weights"
    # shellcheck disable=SC2086
    sample dar "$MODEL" $shown
    # shellcheck disable=SC2086
    sample camera "$MODEL/backbone" $shown

    say "depth: $STEPS steps from the backbone that sees rays alone"
    # shellcheck disable=SC2086
    "$BIN/dar-bundle" synth -o "$OUT/clips" --seed 2026 --count "$CLIPS" --size "$SIZE" --frames "$FRAMES" $SET
    train depth depth "$MODEL/backbone" "[\"$OUT/clips\"]" 'validation.data=[]'
    # shellcheck disable=SC2086
    sample depth "$OUT/train/depth/checkpoint-$STEPS" $shown

    say "one new scene: $STEPS steps on three camera paths; the fourth is held out"
    first=$((4 * SCENE)) held=$(bundle $((4 * SCENE + 3)))
    data="\"$(bundle $first)\", \"$(bundle $((first + 1)))\", \"$(bundle $((first + 2)))\""
    train dar scene "$MODEL" "[$data]" train_batch_size=3 learning_rate=5e-4 "validation.data=[\"$held\"]" \
        "validation.steps=$((STEPS / 3))"
    sample before/held "$MODEL" "$held"
    sample after/held "$OUT/train/scene/checkpoint-$STEPS" "$held"
    evaluate "$OUT/scene" "before=$OUT/before/held" "after=$OUT/after/held" --against "$held"

    say "report"
    # shellcheck disable=SC2086
    evaluate "$OUT/eval" "dar=$OUT/dar" "camera=$OUT/camera" "depth@$STEPS=$OUT/depth" --against $shown
    finish "$OUT/eval"
    echo "one new scene  $OUT/train/scene/loss.svg, before and after $OUT/scene/sheet.png:"
    grep -E '^(before|after) ' "$OUT/scene.txt"
}

if [ ! -f "$MODEL/lora.safetensors" ]; then
    echo "demo: $MODEL has no weights; 'make pretrain' trains them, in some 3 hours on two cores" >&2
    exit 2
fi
mkdir -p "$OUT/scenes"
# Of other weights nothing is kept but scenes.
{ cksum "$MODEL"/*.safetensors "$MODEL"/backbone/*.safetensors && echo "$STEPS"; } >"$OUT/made-of.new"
cmp -s "$OUT/made-of.new" "$OUT/made-of" || find "$OUT" -mindepth 1 -maxdepth 1 ! -name 'made-of*' ! -name scenes \
    ! -name clips -exec rm -rf {} +
mv "$OUT/made-of.new" "$OUT/made-of"
if [ -n "$MESH" ]; then mesh; else scenes; fi
