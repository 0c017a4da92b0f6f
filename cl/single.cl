// Single rays against the scene hierarchy (tree.h): a ray meets the eight boxes of a node at once,
// goes on to the nearest child and keeps the others on a stack, nearest on top, with the distance
// at which it enters them; what lies behind the hit so far is dropped when it is popped. A leaf's
// eight triangles are tested at once. Any-hit rays end at the first hit.
//
// The reference of bundle.cl and ray_stream.cl, which hand their stragglers to it.
//
// Build-time constant: RAYS, to a work-item.

#include "single.h"

#define DEFINE_SINGLE(NAME, ANY, RESULT, STORE)                                                    \
    kernel void NAME(TRAVERSAL_ARGUMENTS, RESULT)                                                  \
    {                                                                                              \
        BEGIN_TRAVERSAL                                                                            \
        for (uint i = first; i < stop; i++) {                                                      \
            const uint ray = ray_in_slot(slots, num_slots, i, org_tnear, dir_tfar);                \
            if (ray == INVALID)                                                                    \
                continue;                                                                          \
            BoxRay box;                                                                            \
            LeafRay r;                                                                             \
            set_box_ray(&box, &scene, org_tnear[ray], dir_tfar[ray]);                              \
            set_leaf_ray(&r, org_tnear[ray], dir_tfar[ray]);                                       \
            if (is_active(&r)) {                                                                   \
                walk(&box, &r, &tree, 0, ANY, &c);                                                 \
                c.rays++;                                                                          \
            }                                                                                      \
            STORE(ray, r.frame.tfar, r.hit.u, r.hit.v, (uint)r.hit.key);                           \
        }                                                                                          \
        store_counts(&c, counts);                                                                  \
    }

DEFINE_SINGLE(intersect_single, false, HIT_RECORDS, STORE_RECORD)
DEFINE_SINGLE(occlude_single, true, BLOCKED_FLAGS, STORE_FLAG)
