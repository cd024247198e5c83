/* dar_eval_study.c: a page that asks people which of two videos they prefer, and the key that only the analysis reads.
 *
 * A trial is a clip and a pair of methods: the first frame, the geometry that was asked for, two videos without names,
 * three questions.  Order of the trials and side of the methods are drawn from the seed.  Neither the page nor its
 * films say which method is which; study-key.json does, and stays with who runs the study.
 *
 * Source: the paper, supplement C. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "data/pictures.h"
#include "data/png.h"
#include "data/resize.h"
#include "data/video.h"
#include "infer/dar_eval_html.h"
#include "lib/json_write.h"
#include "lib/rng.h"
#include "lib/sha256.h"

#define WIDTH 416 /* of a video [px] */

const char *const dar_eval_question[DAR_EVAL_QUESTIONS][2] = {
    { "camera", "Which video follows the camera path better?" },
    { "motion", "Which video follows the motion of the object better?" },
    { "appearance", "Which video keeps the look of the first frame better?" },
};

typedef struct trial {
    size_t clip, pair;
    bool swapped; /* the first method of the pair is on the right */
} trial;

struct study {
    dar_eval *v;
    size_t (*pair)[2];
    size_t pairs, trials;
    trial *trial;
    char id[DAR_SHA256_TEXT];
};

/* ---------------------------------------------------------------- what is asked */

/* NAME:NAME */
static dar_status read_pair(struct study *s, const char *word, dar_err *e)
{
    const char *colon = strchr(word, ':');
    for (int side = 0; side < 2 && colon; side++) {
        const char *name = side ? colon + 1 : word;
        size_t n = side ? strlen(name) : (size_t)(colon - word), m = 0;
        while (m < s->v->methods && (strlen(s->v->method[m].name) != n || memcmp(s->v->method[m].name, name, n) != 0))
            m++;
        s->pair[s->pairs][side] = m;
    }
    size_t *p = s->pair[s->pairs];
    if (!colon || p[0] == s->v->methods || p[1] == s->v->methods || p[0] == p[1])
        return dar_fail(e, DAR_ERR_USAGE, "--study: found '%s', expected two methods as NAME:NAME", word);
    s->pairs++;
    return DAR_OK;
}

/* Every clip that both methods of a pair have, in an order drawn from the seed. */
static void draw(struct study *s)
{
    const uint64_t seed = s->v->seed, stream = dar_rng_stream("study");
    char path[PATH_MAX];
    for (size_t p = 0; p < s->pairs; p++)
        for (size_t c = 0; c < s->v->clips; c++)
            if (dar_eval_find(s->v, s->pair[p][0], c, path) && dar_eval_find(s->v, s->pair[p][1], c, path))
                s->trial[s->trials++] = (trial){ c, p, false };
    for (size_t i = s->trials; i > 1; i--) {
        size_t k = (size_t)dar_rng_below(seed, stream, i, i);
        trial t = s->trial[i - 1];
        s->trial[i - 1] = s->trial[k];
        s->trial[k] = t;
    }
    for (size_t i = 0; i < s->trials; i++) s->trial[i].swapped = dar_rng_below(seed, stream + 1, i, 2) == 1;
}

static void print_trials(const struct study *s, dar_json_writer *w)
{
    dar_json_write_array(w, "trials");
    for (size_t i = 0; i < s->trials; i++) {
        const trial *t = &s->trial[i];
        const dar_eval_clip *c = &s->v->clip[t->clip];
        const size_t *p = s->pair[t->pair];
        dar_json_write_object(w, NULL);
        dar_json_write_text(w, "clip", c->name);
        dar_json_write_text(w, "set", c->set);
        dar_json_write_text(w, "trajectory", c->trajectory);
        dar_json_write_text(w, "family", c->family);
        dar_json_write_text(w, "first", s->v->method[p[0]].name);
        dar_json_write_text(w, "second", s->v->method[p[1]].name);
        dar_json_write_text(w, "left", s->v->method[p[t->swapped]].name);
        dar_json_write_text(w, "right", s->v->method[p[!t->swapped]].name);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
}

/* The key; its trials, hashed, name the study. */
static dar_status write_key(struct study *s, dar_err *e)
{
    dar_json_writer w = { .pretty = true };
    dar_json_write_object(&w, NULL);
    print_trials(s, &w);
    dar_json_write_end(&w);
    if (!w.failed) {
        dar_sha256 h;
        dar_sha256_init(&h);
        dar_sha256_add(&h, w.text, w.size);
        dar_sha256_finish(&h, s->id);
    }
    dar_json_writer_reset(&w);
    dar_json_write_object(&w, NULL);
    dar_json_write_text(&w, "format", "dar-study-key/1");
    dar_json_write_text(&w, "study", s->id);
    print_trials(s, &w);
    dar_json_write_end(&w);
    dar_status status = w.failed ? dar_fail(e, DAR_ERR_NOMEM, "study-key.json: out of memory")
                                 : dar_eval_write(s->v, "study-key.json", w.text, w.size, e);
    dar_json_writer_free(&w);
    return status;
}

/* ---------------------------------------------------------------- films */

/* A film being made: small frames into a file that goes into the page and is removed. */
struct film {
    const dar_eval_clip *clip;
    size_t width, height;
    uint8_t *full, *small;
    float *values;
    char path[PATH_MAX];
    dar_video *video;
};

static dar_status film_open(struct film *f, const dar_eval *v, const dar_eval_clip *c, dar_err *e)
{
    size_t pixels = c->width * c->height;
    *f = (struct film){ .clip = c, .width = (c->width < WIDTH ? c->width : WIDTH) / 2 * 2 };
    f->height = f->width * c->height / c->width / 2 * 2;
    if (snprintf(f->path, sizeof f->path, "%s/film.mp4", v->out) >= PATH_MAX || !f->width || !f->height)
        return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long, or the pictures too small", v->out);
    f->full = malloc(3 * pixels);
    f->small = malloc(3 * f->width * f->height);
    f->values = malloc(3 * pixels * sizeof *f->values);
    if (!f->full || !f->small || !f->values) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", f->path);
    const dar_video_how how = { .fps = c->fps, .codec = DAR_VIDEO_SMALL };
    return dar_video_create(&f->video, f->path, f->width, f->height, &how, e);
}

static dar_status film_add(struct film *f, dar_err *e)
{
    DAR_TRY(dar_resize(f->path, f->full, f->clip->width, f->clip->height, f->small, f->width, f->height, e));
    return dar_video_write(f->video, f->small, e);
}

/* Finish, and put it into the page. */
static dar_status film_close(struct film *f, FILE *page, const char *id, dar_status s, dar_err *e)
{
    if (s == DAR_OK) s = dar_video_commit(f->video, e);
    dar_video_close(f->video);
    if (s == DAR_OK) {
        fprintf(page, "<script type=\"text/plain\" id=\"%s\">", id);
        s = dar_html_file(page, f->path, e);
        fputs("</script>\n", page);
        remove(f->path);
    }
    free(f->full);
    free(f->small);
    free(f->values);
    return s;
}

/* A method's pictures at the times of the clip's frames. */
static dar_status put_method(const struct study *s, FILE *page, size_t c, size_t m, const char *id, dar_err *e)
{
    const dar_eval_clip *clip = &s->v->clip[c];
    char path[PATH_MAX];
    struct film f;
    dar_pictures *p = NULL;
    size_t frames = 0, read = 0;
    dar_status status = film_open(&f, s->v, clip, e);
    if (status == DAR_OK && !dar_eval_find(s->v, m, c, path)) status = dar_fail(e, DAR_ERR_IO, "%s: is gone", path);
    if (status == DAR_OK) status = dar_pictures_open_any(&p, path, clip->width, clip->height, &frames, e);
    for (size_t t = 0; t < clip->frames && status == DAR_OK; t++) {
        size_t last = dar_eval_same_time(t, clip->frames, frames);
        for (; read <= last && status == DAR_OK; read++) status = dar_pictures_read(p, f.full, e);
        if (status == DAR_OK) status = film_add(&f, e);
    }
    dar_pictures_close(p);
    return film_close(&f, page, id, status, e);
}

/* Which way surfaces face, as colours: what was asked for, without any look. */
static dar_status put_condition(const struct study *s, FILE *page, size_t c, dar_bundle *b, const char *id, dar_err *e)
{
    const dar_eval_clip *clip = &s->v->clip[c];
    size_t pixels = clip->width * clip->height;
    struct film f;
    dar_status status = film_open(&f, s->v, clip, e);
    if (status == DAR_OK) status = dar_bundle_need(b, DAR_FAMILY_NORMAL, e);
    for (size_t t = 0; t < clip->frames && status == DAR_OK; t++) {
        status = dar_bundle_values(b, DAR_FAMILY_NORMAL, t, f.values, e);
        for (size_t i = 0; i < pixels && status == DAR_OK; i++) {
            bool seen = f.values[i] != 0 || f.values[pixels + i] != 0 || f.values[2 * pixels + i] != 0;
            for (size_t k = 0; k < 3; k++)
                f.full[3 * i + k] = (uint8_t)(seen ? 127.5f + 127.4f * f.values[k * pixels + i] : 24);
        }
        if (status == DAR_OK) status = film_add(&f, e);
    }
    return film_close(&f, page, id, status, e);
}

/* ---------------------------------------------------------------- the page */

static dar_status put_reference(const struct study *s, FILE *page, const dar_eval_clip *c, dar_bundle *b, dar_err *e)
{
    char path[PATH_MAX];
    size_t width = c->width < WIDTH ? c->width : WIDTH, height = width * c->height / c->width;
    uint8_t *full = malloc(3 * c->width * c->height), *small = malloc(3 * width * (height ? height : 1));
    dar_status status = full && small ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "study.html: out of memory");
    if (snprintf(path, sizeof path, "%s/first.png", s->v->out) >= PATH_MAX)
        status = dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", s->v->out);
    if (status == DAR_OK) status = dar_bundle_rgb(b, 0, full, e);
    if (status == DAR_OK) status = dar_resize(c->path, full, c->width, c->height, small, width, height, e);
    if (status == DAR_OK) status = dar_png_write(path, width, height, 3, small, e);
    if (status == DAR_OK) {
        fputs("<img alt=\"first frame\" src=\"data:image/png;base64,", page);
        status = dar_html_file(page, path, e);
        fputs("\">", page);
        remove(path);
    }
    free(full);
    free(small);
    return status;
}

static void put_questions(FILE *page)
{
    for (int q = 0; q < DAR_EVAL_QUESTIONS; q++)
        fprintf(page,
                "<fieldset data-question=\"%s\"><legend>%s</legend><button data-side=\"left\">left</button>"
                "<button data-side=\"right\">right</button></fieldset>\n",
                dar_eval_question[q][0], dar_eval_question[q][1]);
}

static dar_status put_trial(const struct study *s, FILE *page, size_t i, dar_err *e)
{
    static const char *const what[3] = { "asked", "left", "right" };
    const trial *t = &s->trial[i];
    const dar_eval_clip *c = &s->v->clip[t->clip];
    const size_t *pair = s->pair[t->pair];
    dar_bundle *b;
    char id[3][32];
    for (int k = 0; k < 3; k++) snprintf(id[k], sizeof id[k], "t%zu-%s", i, what[k]);
    DAR_TRY(dar_bundle_open(&b, c->path, e));
    fprintf(page, "<section class=\"trial\" data-trial=\"%zu\" hidden>\n<div class=\"given\"><figure>", i);
    dar_status status = put_reference(s, page, c, b, e);
    fputs("<figcaption>the first frame</figcaption></figure>\n", page);
    for (int k = 0; k < 3; k++)
        fprintf(page,
                "%s<figure><video class=\"on\" data-film=\"%s\" muted loop playsinline></video><figcaption>%s"
                "</figcaption></figure>%s\n",
                k == 1 ? "<div class=\"pair\">" : "", id[k],
                k ? what[k] : "the motion and the camera that were asked for", k == 1 ? "" : "</div>");
    put_questions(page);
    fputs("</section>\n", page);
    if (status == DAR_OK) status = put_condition(s, page, t->clip, b, id[0], e);
    dar_bundle_close(b);
    for (int k = 0; k < 2 && status == DAR_OK; k++)
        status = put_method(s, page, t->clip, pair[k ^ (int)t->swapped], id[1 + k], e);
    return status;
}

static const char style[] =
    "<style>.trial{max-width:900px;margin:1.5rem auto}.given,.pair{display:grid;grid-template-columns:1fr 1fr;gap:1rem;"
    "margin-bottom:1rem}.trial video,.trial img{width:100%;display:block;border-radius:6px;background:#141414}"
    "fieldset{border:0;padding:.7rem 0;margin:0;display:flex;gap:.7rem;align-items:center;border-top:1px solid "
    "var(--line)}legend{float:left;flex:1;margin-right:auto}fieldset button{min-width:6rem;padding:.45rem}"
    "#bar{height:4px;background:var(--accent);width:0;transition:width .3s}[hidden]{display:none!important}"
    ".given figure,.pair figure{padding:.5rem}header{max-width:900px;padding-inline:0}</style>\n";

/* Answers wait in the browser until they are saved: a page that is closed goes on where it was. */
static const char script[] =
    "const trials=[...document.querySelectorAll('.trial')],store='dar-study-'+STUDY;\n"
    "let state=JSON.parse(localStorage.getItem(store)||'null')||{participant:crypto.randomUUID(),answers:[]};\n"
    "let at=Math.floor(state.answers.length/3),begun=0;\n"
    "function collect(){return JSON.stringify({format:'dar-study-answers/1',study:STUDY,participant:state.participant,"
    "answers:state.answers},null,1)}\n"
    "function go(){trials.forEach((t,i)=>t.hidden=i!=at);document.getElementById('bar').style.width="
    "100*at/trials.length+'%';document.getElementById('done').hidden=at<trials.length;begun=performance.now();"
    "scrollTo(0,0)}\n"
    "function answered(t){const all=[...t.querySelectorAll('fieldset')].map(f=>f.querySelector('[aria-pressed=true]'));"
    "if(all.some(b=>!b))return;t.querySelectorAll('fieldset').forEach((f,i)=>state.answers.push({trial:at,"
    "question:f.dataset.question,choice:all[i].dataset.side,seconds:Math.round((performance.now()-begun)/100)/10}));"
    "localStorage.setItem(store,JSON.stringify(state));at++;go()}\n"
    "document.querySelectorAll('.pair').forEach(p=>{const [a,b]=p.querySelectorAll('video');a.ontimeupdate=()=>{"
    "if(Math.abs(a.currentTime-b.currentTime)>.08)b.currentTime=a.currentTime}});\n"
    "trials.forEach(t=>t.querySelectorAll('fieldset button').forEach(b=>b.onclick=()=>{"
    "b.parentNode.querySelectorAll('button').forEach(x=>x.setAttribute('aria-pressed',x==b));answered(t)}));\n"
    "document.getElementById('save').onclick=()=>{const a=document.createElement('a');a.href=URL.createObjectURL("
    "new "
    "Blob([collect()],{type:'application/"
    "json'}));a.download='answers-'+state.participant.slice(0,8)+'.json';a.click()};"
    "\ngo();\n";

static dar_status put_page(struct study *s, FILE *page, dar_err *e)
{
    dar_html_begin(page, "Which is better?");
    fputs(style, page);
    fprintf(page,
            "<div id=\"bar\"></div><header><h1>Which is better?</h1><p class=\"dim\">%zu pairs of videos of one scene "
            "each.  Both were given the first frame, and asked for the motion and the camera on its right, where "
            "colours say which way a surface faces.  Answer by what you see; there is no third choice.</p></header>\n"
            "<main>\n",
            s->trials);
    for (size_t i = 0; i < s->trials; i++) DAR_TRY(put_trial(s, page, i, e));
    fprintf(page,
            "<section id=\"done\" hidden><h2>Thank you</h2><p>Save your answers, and send the file to who asked you."
            "</p><button id=\"save\">save answers</button></section>\n</main>\n<script>\nconst STUDY='%s';\n%s%s"
            "</script>\n</body>\n</html>\n",
            s->id, dar_html_films, script);
    return DAR_OK;
}

static dar_status make(struct study *s, dar_err *e)
{
    char *text = NULL;
    size_t size = 0;
    draw(s);
    if (!s->trials) return dar_fail(e, DAR_ERR_FORMAT, "--study: found no clip that both methods of a pair have");
    DAR_TRY(write_key(s, e));
    FILE *page = open_memstream(&text, &size);
    if (!page) return dar_fail(e, DAR_ERR_NOMEM, "study.html: out of memory");
    dar_status status = put_page(s, page, e);
    bool bad = ferror(page) != 0;
    bad = fclose(page) != 0 || bad;
    if (status == DAR_OK && bad) status = dar_fail(e, DAR_ERR_NOMEM, "study.html: out of memory");
    if (status == DAR_OK) status = dar_eval_write(s->v, "study.html", text, size, e);
    free(text);
    return status;
}

dar_status dar_eval_study(dar_eval *v, const char *const *pair, size_t n, size_t *trials, dar_err *e)
{
    struct study s = { .v = v, .pair = calloc(n, sizeof *s.pair), .trial = calloc(n * v->clips, sizeof *s.trial) };
    dar_status status = s.pair && s.trial ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "study.html: out of memory");
    for (size_t i = 0; i < n && status == DAR_OK; i++) status = read_pair(&s, pair[i], e);
    if (status == DAR_OK) status = make(&s, e);
    *trials = s.trials;
    free(s.pair);
    free(s.trial);
    return status;
}
