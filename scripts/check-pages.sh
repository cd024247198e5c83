#!/bin/sh
# check-pages.sh BUILD: the pages of dar-eval in a browser: every link of the report leads somewhere, every film of it
# plays, and a whole study is answered by a script and read.  Needs the Debian package chromium.
#
# It is part of `make check` alone: with what it needs the browser takes some 400 MB, more than all else together.
build=$(realpath "$1") || exit 2
tmp=$(mktemp -d) || exit 2
trap 'rm -rf "$tmp"' EXIT
cd "$tmp" || exit 2

# The page after its scripts ran, with one more at its end.
browse() {
    cp "$1" page.html && cat >>page.html &&
        timeout 120 chromium --headless=new --no-sandbox --disable-gpu --user-data-dir="$tmp/profile" \
            --virtual-time-budget=20000 --dump-dom "file://$tmp/page.html" 2>browser.log
}

expect() {
    echo "$1"
    [ "$1" = "$2" ] || { echo "expected: $2"; exit 1; }
}

"$build/dar-bundle" synth --set 4d_vis --count 2 --size 96x64 --frames 9 -o set --quiet >/dev/null || exit 1
for m in sharp soft; do
    for b in 000000 000001; do
        mkdir -p $m/$b
        blur=null
        [ $m = soft ] && blur=boxblur=3
        ffmpeg -nostdin -v error -i set/$b/video.mp4 -vf $blur $m/$b/video.mp4 || exit 1
    done
done
"$build/dar-eval" sharp soft --against set -o out --quiet >/dev/null || exit 1
"$build/dar-eval" sharp soft --against set --study sharp:soft -o study --quiet >/dev/null || exit 1

found=$(browse out/report.html <<'END' | sed -n 's/.*<title>\(pictures[^<]*\)<.*/\1/p'
<script>
const ids = [...document.querySelectorAll('a')].map(a => a.getAttribute('href'))
const bad = ids.filter(h => !h.startsWith('#') || !document.getElementById(h.slice(1))).length
let played = 0
const all = [...document.querySelectorAll('video')]
films.disconnect()
for (const v of all) {
    v.onloadeddata = () => {
        played += v.videoWidth > 0
        document.title = `pictures ${played} of ${all.length}, ${bad} bad links`
    }
    load(v)
}
</script>
END
)
expect "$found" "pictures 4 of 4, 0 bad links"

browse study/study.html <<'END' | sed -n '/<pre id="collected">/,/<\/pre>/p' | sed 's/<[^>]*>//g' >answers.json
<script>
for (let n = 0; at < trials.length && n < 100; n++)
    trials[at].querySelectorAll('fieldset').forEach(f => f.querySelectorAll('button')[n % 2].click())
const p = document.createElement('pre')
p.id = 'collected'
p.textContent = collect()
document.body.replaceChildren(p)
</script>
END
expect "$("$build/dar-eval" --answers answers.json --key study/study-key.json -o told)" "told: 6 answers"
