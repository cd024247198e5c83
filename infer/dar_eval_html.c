/* dar_eval_html.c: see dar_eval_html.h.  Pages need nothing but themselves: no network, no file beside them. */
#include "infer/dar_eval_html.h"

#include <stdint.h>
#include <stdlib.h>

#include "lib/file.h"

void dar_html_text(FILE *f, const char *text)
{
    for (; *text; text++) {
        const char *as = *text == '&'   ? "&amp;"
                         : *text == '<' ? "&lt;"
                         : *text == '>' ? "&gt;"
                         : *text == '"' ? "&quot;"
                                        : NULL;
        if (as) fputs(as, f);
        else fputc(*text, f);
    }
}

dar_status dar_html_file(FILE *f, const char *path, dar_err *e)
{
    static const char letter[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    dar_file_map m;
    DAR_TRY(dar_file_map_open(&m, path, e));
    for (size_t i = 0; i < m.size; i += 3) {
        size_t left = m.size - i;
        uint32_t v =
            (uint32_t)m.data[i] << 16 | (left > 1 ? (uint32_t)m.data[i + 1] << 8 : 0) | (left > 2 ? m.data[i + 2] : 0);
        fputc(letter[v >> 18], f);
        fputc(letter[v >> 12 & 63], f);
        fputc(left > 1 ? letter[v >> 6 & 63] : '=', f);
        fputc(left > 2 ? letter[v & 63] : '=', f);
    }
    dar_file_map_close(&m);
    return DAR_OK;
}

static const char style[] =
    ":root{color-scheme:light dark;--bg:#fbfbfa;--fg:#1c1d1f;--dim:#6a6d73;--line:#e2e2de;--card:#fff;"
    "--accent:#0b62b0;--row:#f4f4f1}\n"
    "@media(prefers-color-scheme:dark){:root{--bg:#131416;--fg:#e6e6e3;--dim:#969aa2;--line:#2b2d31;--card:#1a1b1e;"
    "--accent:#6cb2f5;--row:#202226}}\n"
    "*{box-sizing:border-box}html{scroll-behavior:smooth;scroll-padding-top:3.5rem}\n"
    "body{margin:0;background:var(--bg);color:var(--fg);font:15px/1.55 system-ui,-apple-system,'Segoe UI',Roboto,"
    "'Helvetica Neue',sans-serif}\n"
    "main{max-width:1240px;margin:0 auto;padding:0 1.5rem 5rem}\n"
    "header{max-width:1240px;margin:0 auto;padding:3rem 1.5rem 1rem}\n"
    "h1{font-size:2rem;line-height:1.2;letter-spacing:-.02em;margin:0 0 .4rem;font-weight:650}\n"
    "h2{font-size:1.25rem;letter-spacing:-.01em;margin:3rem 0 .3rem;font-weight:620}\n"
    "h3{font-size:1rem;margin:2rem 0 .3rem;font-weight:600}\n"
    ".list{display:flex;flex-wrap:wrap;gap:.1rem 1.1rem;max-width:none;font-size:.87rem}\n"
    "p{max-width:78ch;margin:.2rem 0 "
    "1rem}a{color:var(--accent);text-decoration:none}a:hover{text-decoration:underline}\n"
    ".dim,.note,figcaption{color:var(--dim)}.note,figcaption{font-size:.87rem}\n"
    "nav{position:sticky;top:0;z-index:9;background:color-mix(in srgb,var(--bg) 88%,transparent);"
    "backdrop-filter:blur(8px);border-bottom:1px solid var(--line)}\n"
    "nav div{max-width:1240px;margin:0 auto;padding:.65rem 1.5rem;display:flex;gap:1.3rem;overflow-x:auto;"
    "white-space:nowrap;font-size:.9rem}\n"
    ".scroll{overflow-x:auto;border:1px solid var(--line);border-radius:10px;background:var(--card)}\n"
    "table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;font-size:.9rem}\n"
    "th,td{padding:.45rem .8rem;text-align:right;white-space:nowrap;vertical-align:baseline}\n"
    "th{font-weight:560;color:var(--dim);border-bottom:1px solid var(--line);font-size:.83rem}\n"
    "th:first-child,td:first-child{text-align:left;position:sticky;left:0;background:var(--card)}\n"
    "td:first-child{font-weight:520}tr+tr td{border-top:1px solid var(--line)}\n"
    "tbody tr:hover td{background:var(--row)}tr.apart td{color:var(--dim)}tr.apart td:first-child{font-weight:400}\n"
    "td small{display:block;color:var(--dim);font-size:.74rem;line-height:1.2;font-weight:400}\n"
    ".best{font-weight:680;color:var(--accent)}.second{text-decoration:underline;text-underline-offset:3px;"
    "text-decoration-thickness:1px}\n"
    ".plots{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,520px),1fr));gap:1.2rem;margin-top:1rem}"
    "\n"
    "figure{margin:0;border:1px solid "
    "var(--line);border-radius:10px;background:var(--card);padding:.8rem;overflow:hidden}\n"
    "figure svg{width:100%;height:auto;display:block}\n"
    "@media(prefers-color-scheme:dark){figure svg{filter:invert(.89) hue-rotate(180deg)}}\n" /* plots are on white */
    ".clip{margin-top:2rem}.clip h3{margin:0 0 .5rem;font-size:1rem;font-weight:600;display:flex;gap:.7rem;"
    "align-items:baseline;flex-wrap:wrap}.clip h3 span{font-weight:400;color:var(--dim);font-size:.85rem}\n"
    ".film{position:relative;background:#141414;border-radius:10px;overflow:hidden;width:100%}\n"
    ".film video{position:absolute;inset:0;width:100%;height:100%;display:block;opacity:0;transition:opacity .2s}\n"
    ".film video.on{opacity:1}\n"
    ".film b{position:absolute;padding:1px 7px;margin:5px;font-weight:520;font-size:.72rem;line-height:1.5;color:#fff;"
    "background:rgb(0 0 0/.55);border-radius:5px;pointer-events:none;max-width:calc(100%/var(--n) - 12px);"
    "overflow:hidden;text-overflow:ellipsis;white-space:nowrap}.film b "
    "i{font-style:normal;opacity:.75;margin-left:.4em}\n"
    "button{font:inherit;font-size:.82rem;color:var(--fg);background:var(--card);border:1px solid var(--line);"
    "border-radius:7px;padding:.2rem .7rem;cursor:pointer}button:hover{border-color:var(--accent)}\n"
    "button[aria-pressed=true]{background:var(--accent);border-color:var(--accent);color:var(--bg)}\n"
    ".scale{white-space:nowrap}.ramp{display:inline-block;width:120px;height:.7em;border-radius:3px;margin:0 "
    ".5em;background:linear-gradient(90deg,"
    "#000004,#1c1044,#4f127b,#812581,#b5367a,#e55064,#fb8761,#fec287,#fcfdbf)}\n"
    "@media print{nav,button{display:none}}\n";

void dar_html_begin(FILE *f, const char *title)
{
    fputs("<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
          "<meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\n<title>",
          f);
    dar_html_text(f, title);
    fprintf(f, "</title>\n<link rel=\"icon\" href=\"data:,\">\n<style>\n%s</style>\n</head>\n<body>\n", style);
}

/* <video data-film="ID">, whose file is in <script type="text/plain" id="ID">. */
const char dar_html_films[] =
    "function load(v){const s=document.getElementById(v.dataset.film);if(v.src||!s)return;"
    "const t=atob(s.textContent),b=new Uint8Array(t.length);for(let i=0;i<t.length;i++)b[i]=t.charCodeAt(i);"
    "v.src=URL.createObjectURL(new Blob([b],{type:'video/mp4'}))}\n"
    "function unload(v){if(!v.src)return;v.pause();URL.revokeObjectURL(v.src);v.removeAttribute('src');v.load()}\n"
    "const still=matchMedia('(prefers-reduced-motion:reduce)').matches;\n"
    "const films=new IntersectionObserver(es=>{for(const x of es){x.target.seen=x.isIntersecting;show(x.target)}},"
    "{rootMargin:'250px'});\n"
    "function show(v){if(v.seen&&v.classList.contains('on')){load(v);if(!still)v.play().catch(()=>{})}else unload(v)}\n"
    "document.querySelectorAll('video[data-film]').forEach(v=>films.observe(v));\n";
