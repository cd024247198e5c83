#!/bin/sh
# pretrain.sh: the small model from nothing: scenes -> autoencoder -> backbone that sees rays alone -> DAR's adapter and
# low-rank additions -> models/dar-tiny, with what each training told.  Sizes and steps are those of the configurations;
# one seed says everything.  Cut it at any moment and start it again: every stage goes on where it was.
#
#   KEYS="max_train_steps=10 ..."   of every training, over those of the configurations
set -eu
CONFIGS=${CONFIGS:-train/configs/dar-tiny}
BIN=${BIN:-build/release}
DATA=${DATA:-out/data}
OUT=${OUT:-out/pretrain}
MODEL=${MODEL:-models/dar-tiny}
CLIPS=${CLIPS:-1200}    # to learn from
HELD=${HELD:-68}        # to look at
SET=${SET---coarse}    # options of dar-bundle synth
KEYS=${KEYS:-}

say() {
    printf '\n%s: %s\n' "$(date +%T)" "$*"
}

# The newest checkpoint of a stage.
last() {
    find "$OUT/$1" -maxdepth 1 -name 'checkpoint-*' ! -name '*.tmp-*' | sort -V | tail -1
}

# stage NAME CONFIG KEY=VALUE...
stage() {
    name=$1 config=$2
    shift 2
    given=$#
    for key in "$@" $KEYS; do set -- "$@" --set "$key"; done
    shift "$given"
    "$BIN/dar-train" "$CONFIGS/$config.json" --resume auto --set "output_dir=$OUT/$name" \
        --set "data=[\"$DATA/train\"]" --set "validation.data=[\"$DATA/4d_vis\"]" "$@"
}

# What a stage told, as a member of an object.
summary() {
    awk -v name="$1" '
        function number(key) {
            if (!match($0, "\"" key "\": [-0-9.e+]+")) return ""
            return substr($0, RSTART + length(key) + 4, RLENGTH - length(key) - 4)
        }
        /"kind": "step"/ { step = number("step"); loss = number("smoothed"); seconds += number("seconds") }
        /"kind": "start"/ { starts++ }
        /"kind": "validate"/ { psnr = number("psnr"); ssim = number("ssim") }
        /"kind": "sensitivity"/ { own = number("loss"); other = number("shuffled") }
        END {
            printf "    \"%s\": { \"steps\": %d, \"seconds\": %.0f, \"starts\": %d", name, step, seconds, starts
            printf ", \"loss\": %s", loss
            if (psnr != "") printf ", \"held_out_psnr\": %s", psnr
            if (ssim != "") printf ", \"held_out_ssim\": %s", ssim
            if (own != "") printf ", \"held_out_loss\": %s, \"with_another_condition\": %s", own, other
            printf " }"
        }' "$OUT/$1/log.jsonl"
}

# Beside the weights: figures, curves, the last samples.
results() {
    to=$MODEL/results
    mkdir -p "$to"
    {
        printf '{\n    "clips": %d,\n    "weights_bytes": %d,\n' "$CLIPS" \
            "$(cat "$MODEL"/*.safetensors "$MODEL"/backbone/*.safetensors | wc -c)"
        summary vae && echo , && summary backbone && echo , && summary dar && printf '\n}\n'
    } >"$to/summary.json"
    for name in vae backbone dar; do
        for plot in loss loss_sigma psnr; do
            [ ! -f "$OUT/$name/$plot.svg" ] || cp "$OUT/$name/$plot.svg" "$to/$name-$plot.svg"
        done
        cp "$OUT/$name/loss.csv" "$to/$name-loss.csv"
        samples=$(find "$OUT/$name" -path '*/samples/step-*' -type d | sort | tail -1)
        k=0
        for png in ${samples:+"$samples"/*.png}; do
            [ "$k" -ge 2 ] || cp "$png" "$to/$name-sample-$k.png"
            k=$((k + 1))
        done
    done
}

mkdir -p "$DATA" "$OUT"
say "1 of 5: $CLIPS scenes to learn from, $HELD to look at"
# shellcheck disable=SC2086
"$BIN/dar-bundle" synth -o "$DATA/train" --count "$CLIPS" $SET
# shellcheck disable=SC2086
"$BIN/dar-bundle" synth -o "$DATA/4d_vis" --set 4d_vis --count "$HELD" $SET

say "2 of 5: the autoencoder"
stage vae vae

say "3 of 5: the backbone, from rays alone, on latents of the autoencoder"
stage backbone pretrain "model=$(last vae)"

say "4 of 5: DAR's adapter and low-rank additions; the backbone is frozen"
stage dar dar "model=$(last backbone)" weights=null

say "5 of 5: the model"
"$BIN/dar-train" "$(last dar)" --export "$MODEL"
results
cat "$MODEL/results/summary.json"
say "done: $MODEL; what became of it: $MODEL/results; 'make demo' shows it"
