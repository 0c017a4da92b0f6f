// Unions of cone-spheres as Reis et al. (2017, section 3.3.6) publish them, child by child.
//
// Looser than those of hierarchy.cl; kept so that the paper's counts can be reproduced. Rays join a
// cone by Szecsi's rule (equations 1 to 4; the signs, garbled in print, follow from the drawing), cones
// by half their axes' angle plus the larger half-angle (5, 6: the printed left side must be the angle,
// not its cosine), spheres by the middle of their centres (7, 8). Nodes know no tfar, and no boxes.
//
// Every step is rounded outwards by the slacks of hierarchy.cl, and changes the lanes that join alone.

// The cones whose rays lie within `sine` of `axis`; any direction where that is pi/2 or more.
inline void set_cones(Nodes *n, int16 joins, Vectors axis, float16 sine, int16 wide)
{
    sine += SINE_SLACK;
    const int16 narrow = ~wide & (sine < 1.0f);
    const Vectors any = {1.0f, 0.0f, 0.0f};
    n->axis = choose(joins, choose(narrow, axis, any), n->axis);
    const float16 cosine = narrow ? SQRT16((1.0f - sine) * (1.0f + sine)) : 0.0f;
    n->cosine = joins ? cosine : n->cosine;
    sine = narrow ? sine : 1.0f;
    n->sine = joins ? sine : n->sine;
}

inline float16 sine_between(Vectors a, Vectors b) { return length_of(cross_of(a, b)); }

// Equations 1 to 4: the far edge e of the cone, seen from the ray r, and r become the new edges.
inline void add_rays(Nodes *n, int16 joins, Vectors r)
{
    const float16 along = dot_of(n->axis, r), across = sine_between(n->axis, r);
    const int16 inside = (along > 0.0f) & (across <= n->sine);
    const Vectors away = over(minus(times(n->axis, along), r), across);
    const Vectors edge = plus(times(n->axis, n->cosine), times(away, n->sine));
    // A ray opposite to the axis has no plane with it: wide below.
    const Vectors e = choose((n->sine > 0.0f) & (across > 0.0f), edge, n->axis);
    const Vectors sum = plus(e, r);
    const float16 length = length_of(sum);
    const Vectors axis = over(sum, length);
    const int16 turned = across * n->cosine + along * n->sine <= 0.0f; // theta + phi >= pi
    set_cones(n, joins & ~inside, axis, larger(sine_between(axis, e), sine_between(axis, r)),
              turned | ~(length > 0x1p-10f) | (dot_of(axis, r) <= SINE_SLACK));
}

// Equations 5 and 6.
inline void add_cones(Nodes *n, int16 joins, const Nodes *other)
{
    const Vectors sum = plus(n->axis, other->axis);
    const float16 length = length_of(sum);
    const Vectors axis = over(sum, length);
    const int16 first = n->sine >= other->sine;
    const float16 sine = first ? n->sine : other->sine, cosine = first ? n->cosine : other->cosine;
    const float16 half_across
        = larger(sine_between(axis, n->axis), sine_between(axis, other->axis));
    const float16 half_along = dot_of(axis, n->axis);
    const int16 wide = (other->cosine <= 0.0f) | ~(length > 0x1p-10f)
                       | (half_along * cosine - half_across * sine <= SINE_SLACK);
    set_cones(n, joins, axis, half_across * cosine + half_along * sine, wide);
}

// Equations 7 and 8; the radius from the middle as it was rounded, which may be by more than a radius.
inline void add_spheres(Nodes *n, int16 joins, const Nodes *other)
{
    const Vectors middle = plus(n->centre, times(minus(other->centre, n->centre), 0.5f));
    const float16 radius = larger(length_of(minus(n->centre, middle)) + n->radius,
                                  length_of(minus(other->centre, middle)) + other->radius)
                           * RADIUS_SLACK;
    const int16 bounded = radius < INFINITY; // as in hierarchy.cl
    const Vectors centre = choose(bounded, middle, all_axes(0.0f));
    n->centre = choose(joins, centre, n->centre);
    const float16 radius_or_any = bounded ? radius : INFINITY;
    n->radius = joins ? radius_or_any : n->radius;
}

// The parents of sixteen times ARITY children, where any of these is not null.
inline Nodes enclose(const Nodes *children)
{
    Nodes n = children[0];
    for (uint k = 1; k < ARITY; k++) {
        const Nodes *c = children + k;
        const int16 first = is_live(c) & ~is_live(&n), joins = is_live(c) & ~first;
        add_spheres(&n, joins, c);
        const int16 narrow = joins & (n.cosine > 0.0f); // else any direction already
        add_rays(&n, narrow & (c->sine == 0.0f), c->axis);
        add_cones(&n, narrow & (c->sine > 0.0f), c);
        n.centre = choose(first, c->centre, n.centre);
        n.radius = first ? c->radius : n.radius;
        n.axis = choose(first, c->axis, n.axis);
        n.cosine = first ? c->cosine : n.cosine;
        n.sine = first ? c->sine : n.sine;
        n.reach = first ? c->reach : n.reach;
    }
    n.reach = INFINITY;
    return n;
}
