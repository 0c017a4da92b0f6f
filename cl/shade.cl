// Whitted shading (Whitted 1980): surfaces from hits, direct light, and the next ray streams.
//
// One work-item per ray; ray i belongs to pixel i. Model, written once and shared in words only with
// the reference renderer in baselines/:
//   Ng  geometric normal, turned towards the viewer; Ns  interpolated normal, turned to Ng's side
//   opaque = (1 - transmission) (1 - reflectivity),  base = diffuse * texture * vertex colour
//   colour = emission + ambient base opaque
//            + sum over lights that are seen from both Ng's and Ns's front and not blocked:
//              I (opaque base (Ns.L) + specular max(0, Ns.H)^shininess)
//   reflection  (1 - transmission) reflectivity + transmission F,   refraction  transmission (1 - F)
//   with F the unpolarised Fresnel reflectance, 1 where total internal reflection begins.
// Self-intersection: rays leave from the hit point moved by `epsilon` along Ng, to the side they go;
// shadow rays of point and spot lights start at the light and end there (Roger et al. 2007, 3.5.1).
//
// Arrays:
//   materials      5 float4 per geometry: (diffuse, shininess) (specular, ior) (reflectivity, -)
//                  (transmission, -) (emission, -)
//   texture_info   uint4 per geometry: first texel, width (0: none), height, flags (1: vertex normals,
//                  2: vertex colours)
//   lights         4 float4 per light: (position, kind) (direction of travel, falloff) (colour, -)
//                  (cosine of the inner angle, of the outer angle, -, -)
//   weights        float4 per ray: what its light counts for in the pixel; 0 where there is no ray

#include "common.h"

#define HAS_NORMALS 1u
#define HAS_COLORS 2u
#define POINT_LIGHT 0.0f
#define DIRECTIONAL_LIGHT 1.0f
#define SPOT_LIGHT 2.0f
#define PER_ITEM 64

#define MATERIAL_FLOAT4S 5
#define DIFFUSE 0
#define SPECULAR 1
#define REFLECTIVITY 2
#define TRANSMISSION 3
#define EMISSION 4

inline float4 unit(float4 v) { return v / sqrt(dot3(v, v)); }

inline float4 load3(global const float *rows, uint i)
{
    global const float *p = rows + 3 * (ulong)i;
    return (float4)(p[0], p[1], p[2], 0.0f);
}

inline int wrap(int i, int n)
{
    const int r = i % n;
    return r < 0 ? r + n : r;
}

inline float4 texel(global const uchar *texels, global const float *linear, uint4 info, int x, int y)
{
    const ulong i = (ulong)info.x + (ulong)wrap(y, info.z) * info.y + wrap(x, info.y);
    return (float4)(linear[texels[3 * i]], linear[texels[3 * i + 1]], linear[texels[3 * i + 2]], 0);
}

// Bilinear in linear light, repeated; v = 0 is the bottom row.
inline float4 sample_texture(global const uchar *texels, global const float *linear, uint4 info,
                             float2 uv)
{
    const float x = (uv.x - floor(uv.x)) * info.y - 0.5f;
    const float y = (1.0f - (uv.y - floor(uv.y))) * info.z - 0.5f;
    const float left = floor(x), top = floor(y), a = x - left, b = y - top;
    const int i = (int)left, j = (int)top;
    const float4 upper = (1.0f - a) * texel(texels, linear, info, i, j)
                         + a * texel(texels, linear, info, i + 1, j);
    const float4 lower = (1.0f - a) * texel(texels, linear, info, i, j + 1)
                         + a * texel(texels, linear, info, i + 1, j + 1);
    return (1.0f - b) * upper + b * lower;
}

// The surface of every hit (the G-buffer), and its own light into the image.
//   position  xyz, w: geometry (a float holds 24 bits of it), -1 where missed
//   geometric xyz: Ng, w: 1 where the ray enters the surface's front, else -1
kernel void evaluate_surfaces(
    const uint num_rays, global const uint *restrict hit_triangle, global const float *restrict hit_u,
    global const float *restrict hit_v, global const float4 *restrict dir_tfar,
    global const float4 *restrict triangles, global const uint *restrict faces,
    global const uint *restrict geom_ids, global const float *restrict normals,
    global const float2 *restrict uvs, global const float *restrict colors,
    global const float4 *restrict materials, global const uint4 *restrict texture_info,
    global const uchar *restrict texels, global const float *restrict linear,
    const float4 background, const float4 ambient, global const float4 *restrict weights,
    global float4 *restrict position, global float4 *restrict shading,
    global float4 *restrict geometric, global float4 *restrict base, global float4 *restrict image)
{
    const uint i = get_global_id(0);
    if (i >= num_rays)
        return;
    const uint id = hit_triangle[i];
    if (id == INVALID) {
        position[i] = (float4)(0.0f, 0.0f, 0.0f, -1.0f);
        image[i] += weights[i] * background;
        return;
    }
    const uint geometry = geom_ids[id];
    global const float4 *m = materials + MATERIAL_FLOAT4S * geometry;
    const uint4 info = texture_info[geometry];
    const uint a = faces[3 * (ulong)id], b = faces[3 * (ulong)id + 1], c = faces[3 * (ulong)id + 2];
    const float4 v0 = triangles[3 * (ulong)id], v1 = triangles[3 * (ulong)id + 1],
                 v2 = triangles[3 * (ulong)id + 2];
    const float u = hit_u[i], v = hit_v[i], w = 1.0f - u - v;
    const float4 d = dir_tfar[i];

    float4 ng = unit(cross3(v1 - v0, v2 - v0));
    const float side = dot3(d, ng) < 0.0f ? 1.0f : -1.0f;
    ng *= side;
    float4 ns = ng;
    if (info.w & HAS_NORMALS) {
        const float4 n = w * load3(normals, a) + u * load3(normals, b) + v * load3(normals, c);
        const float length2 = dot3(n, n);
        if (length2 > 0.0f)
            ns = n / sqrt(length2) * (dot3(n, ng) < 0.0f ? -1.0f : 1.0f);
    }
    float4 colour = m[DIFFUSE];
    if (info.y != 0)
        colour *= sample_texture(texels, linear, info, w * uvs[a] + u * uvs[b] + v * uvs[c]);
    if (info.w & HAS_COLORS)
        colour *= w * load3(colors, a) + u * load3(colors, b) + v * load3(colors, c);
    colour.w = 0.0f;

    const float4 opaque = (1.0f - m[TRANSMISSION]) * (1.0f - m[REFLECTIVITY]);
    position[i] = w * v0 + u * v1 + v * v2;
    position[i].w = (float)geometry;
    shading[i] = ns;
    geometric[i] = (float4)(ng.x, ng.y, ng.z, side);
    base[i] = colour;
    image[i] += weights[i] * (m[EMISSION] + ambient * colour * opaque);
}

typedef struct {
    float4 direction; // to the light, unit
    float distance;
    float4 intensity;
} Lit;

inline Lit light_at(global const float4 *light, float4 p)
{
    Lit lit;
    if (light[0].w == DIRECTIONAL_LIGHT) {
        lit.direction = -unit(light[1]);
        lit.distance = INFINITY;
        lit.intensity = light[2];
        return lit;
    }
    const float4 to_light = light[0] - p;
    lit.distance = sqrt(dot3(to_light, to_light));
    lit.direction = to_light / lit.distance;
    lit.intensity = light[2];
    if (light[1].w != 0.0f)
        lit.intensity /= lit.distance * lit.distance;
    if (light[0].w == SPOT_LIGHT) {
        const float cosine = -dot3(lit.direction, unit(light[1]));
        const float s = (cosine - light[3].y) / (light[3].x - light[3].y);
        const float inside = s < 0.0f ? 0.0f : s > 1.0f ? 1.0f : s;
        lit.intensity *= inside * inside;
    }
    return lit;
}

inline bool faces_light(float4 direction, float4 ng, float4 ns)
{
    return dot3(ng, direction) > 0.0f && dot3(ns, direction) > 0.0f;
}

// A shadow ray per surface that could see the light; inactive elsewhere.
kernel void make_shadow_rays(const uint num_rays, global const float4 *restrict light,
                             const float epsilon, global const float4 *restrict weights,
                             global const float4 *restrict position,
                             global const float4 *restrict shading,
                             global const float4 *restrict geometric,
                             global float4 *restrict org_tnear, global float4 *restrict dir_tfar)
{
    const uint i = get_global_id(0);
    if (i >= num_rays)
        return;
    const float4 p = position[i], ng = geometric[i];
    const float4 weight = weights[i];
    float4 org = 0.0f, dir = (float4)(0.0f, 0.0f, 1.0f, -1.0f);
    if (p.w >= 0.0f && weight.x + weight.y + weight.z > 0.0f) {
        const Lit lit = light_at(light, p);
        if (faces_light(lit.direction, ng, shading[i])) {
            const float4 target = p + epsilon * ng;
            if (light[0].w == DIRECTIONAL_LIGHT) {
                org = target;
                dir = lit.direction;
                dir.w = INFINITY;
            } else {
                org = light[0];
                dir = target - light[0];
                dir.w = 1.0f;
            }
            org.w = 0.0f;
        }
    }
    org_tnear[i] = org;
    dir_tfar[i] = dir;
}

// The light of one source into the image, where it is not blocked.
kernel void add_light(const uint num_rays, global const float4 *restrict light,
                      global const uchar *restrict blocked, global const float4 *restrict dir_tfar,
                      global const float4 *restrict weights, global const float4 *restrict position,
                      global const float4 *restrict shading, global const float4 *restrict geometric,
                      global const float4 *restrict base, global const float4 *restrict materials,
                      global float4 *restrict image)
{
    const uint i = get_global_id(0);
    if (i >= num_rays)
        return;
    const float4 p = position[i], ns = shading[i];
    if (p.w < 0.0f || blocked[i])
        return;
    const Lit lit = light_at(light, p);
    if (!faces_light(lit.direction, geometric[i], ns))
        return;
    global const float4 *m = materials + MATERIAL_FLOAT4S * (uint)p.w;
    const float4 opaque = (1.0f - m[TRANSMISSION]) * (1.0f - m[REFLECTIVITY]);
    float4 sum = opaque * base[i] * dot3(ns, lit.direction);
    const float4 highlight = m[SPECULAR];
    if (highlight.x + highlight.y + highlight.z > 0.0f) {
        const float4 h = unit(lit.direction - unit(dir_tfar[i]));
        const float cosine = dot3(ns, h);
        const float shininess = m[DIFFUSE].w;
        sum += highlight * (cosine > 0.0f ? pow(cosine, shininess) : shininess == 0.0f ? 1.0f : 0.0f);
    }
    image[i] += weights[i] * lit.intensity * sum;
}

inline float4 reflect(float4 d, float4 n) { return d - 2.0f * dot3(d, n) * n; }

// Refracted unit direction of d at normal n (against d) with eta = n_outside / n_inside, and the
// Fresnel reflectance. Returns false for total internal reflection.
inline bool refract(float4 d, float4 n, float eta, float4 *direction, float *reflectance)
{
    const float c = -dot3(d, n);
    const float k = 1.0f - eta * eta * (1.0f - c * c);
    if (k < 0.0f || c <= 0.0f) { // c = 0 is grazing, all is reflected
        *reflectance = 1.0f;
        return false;
    }
    const float ct = sqrt(k);
    const float parallel = (c - eta * ct) / (c + eta * ct);
    const float perpendicular = (eta * c - ct) / (eta * c + ct);
    *reflectance = 0.5f * (parallel * parallel + perpendicular * perpendicular);
    *direction = eta * d + (eta * c - ct) * n;
    return true;
}

inline bool counts(float4 weight, float threshold)
{
    return MAX(weight.x, MAX(weight.y, weight.z)) >= threshold;
}

inline void store_ray(bool alive, float4 org, float4 dir, float4 weight, ulong i,
                      global float4 *org_tnear, global float4 *dir_tfar, global float4 *weights)
{
    org.w = 0.0f;
    dir.w = INFINITY;
    weight.w = 0.0f;
    org_tnear[i] = alive ? org : (float4)0.0f;
    dir_tfar[i] = alive ? dir : (float4)(0.0f, 0.0f, 1.0f, -1.0f);
    weights[i] = alive ? weight : (float4)0.0f;
}

// Reflection and refraction rays of every surface. alive[0], alive[1]: how many of each were made.
kernel void spawn_rays(
    const uint num_rays, const float epsilon, const float threshold,
    global const float4 *restrict dir_tfar, global const float4 *restrict weights,
    global const float4 *restrict position, global const float4 *restrict shading,
    global const float4 *restrict geometric, global const float4 *restrict materials,
    global float4 *restrict reflected_org,
    global float4 *restrict reflected_dir, global float4 *restrict reflected_weights,
    global float4 *restrict refracted_org, global float4 *restrict refracted_dir,
    global float4 *restrict refracted_weights, global uint *restrict alive)
{
    const ulong first = (ulong)get_global_id(0) * PER_ITEM;
    uint num_reflected = 0, num_refracted = 0;
    for (ulong i = first; i < first + PER_ITEM && i < num_rays; i++) {
        const float4 p = position[i];
        float4 reflected = 0.0f, refracted = 0.0f, mirror = 0.0f, through = 0.0f;
        float4 ng = 0.0f;
        if (p.w >= 0.0f) {
            global const float4 *m = materials + MATERIAL_FLOAT4S * (uint)p.w;
            const float4 tau = m[TRANSMISSION];
            const float4 d = unit(dir_tfar[i]), ns = shading[i];
            const float side = geometric[i].w;
            ng = geometric[i];
            ng.w = 0.0f;
            // The shading normal where it reflects to the outside, else the geometric one.
            const bool usable = dot3(d, ns) < 0.0f && dot3(reflect(d, ns), ng) > 0.0f;
            const float4 n = usable ? ns : ng;
            float reflectance = 0.0f;
            if (tau.x + tau.y + tau.z > 0.0f) {
                const float ior = m[SPECULAR].w;
                const float eta = side > 0.0f ? 1.0f / ior : ior;
                bool passes = refract(d, n, eta, &through, &reflectance);
                if (passes && dot3(through, ng) >= 0.0f) {
                    float unused;
                    passes = refract(d, ng, eta, &through, &unused);
                }
                if (passes)
                    refracted = weights[i] * tau * (1.0f - reflectance);
            }
            mirror = reflect(d, n);
            reflected = weights[i] * ((1.0f - tau) * m[REFLECTIVITY] + tau * reflectance);
        }
        const bool reflects = counts(reflected, threshold), refracts = counts(refracted, threshold);
        store_ray(reflects, p + epsilon * ng, mirror, reflected, i, reflected_org, reflected_dir,
                  reflected_weights);
        store_ray(refracts, p - epsilon * ng, through, refracted, i, refracted_org, refracted_dir,
                  refracted_weights);
        num_reflected += reflects;
        num_refracted += refracts;
    }
    if (num_reflected)
        atomic_add(alive, num_reflected);
    if (num_refracted)
        atomic_add(alive + 1, num_refracted);
}
