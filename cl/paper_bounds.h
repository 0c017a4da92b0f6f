// Unions of cone-spheres as Reis et al. (2017, section 3.3.6) publish them, child by child.
//
// Looser than those of hierarchy.cl; kept so that the paper's counts can be reproduced. Rays join a
// cone by Szecsi's rule (equations 1 to 4; the signs, garbled in print, follow from the drawing), cones
// by half their axes' angle plus the larger half-angle (5, 6: the printed left side must be the angle,
// not its cosine), spheres by the middle of their centres (7, 8). Nodes know no tfar.
//
// Every step is rounded outwards by the slacks of hierarchy.cl.

// The cone whose rays lie within `sine` of `axis`; any direction where that is pi/2 or more.
inline void set_cone(Node *n, float4 axis, float sine, bool wide)
{
    sine += SINE_SLACK;
    wide = wide || !(sine < 1.0f);
    n->axis = wide ? (float4)(1.0f, 0.0f, 0.0f, 0.0f) : axis;
    n->sine = wide ? 1.0f : sine;
    n->cosine = wide ? 0.0f : sqrt((1.0f - sine) * (1.0f + sine));
}

inline float sine_between(float4 a, float4 b)
{
    const float4 across = cross3(a, b);
    return sqrt(dot3(across, across));
}

// Equations 1 to 4: the far edge e of the cone, seen from the ray r, and r become the new edges.
inline void add_ray(Node *n, float4 r)
{
    const float along = dot3(n->axis, r), across = sine_between(n->axis, r);
    if (along > 0.0f && across <= n->sine)
        return;
    float4 e = n->axis;
    if (n->sine > 0.0f && across > 0.0f) // a ray opposite to the axis has no plane with it: wide below
        e = n->axis * n->cosine + (along * n->axis - r) / across * n->sine;
    const float4 sum = e + r;
    const float length = sqrt(dot3(sum, sum));
    const float4 axis = sum / length;
    const bool turned = across * n->cosine + along * n->sine <= 0.0f; // theta + phi >= pi
    const float edge = sine_between(axis, e), ray = sine_between(axis, r);
    set_cone(n, axis, MAX(edge, ray),
             turned || !(length > 0x1p-10f) || dot3(axis, r) <= SINE_SLACK);
}

// Equations 5 and 6.
inline void add_cone(Node *n, const Node *other)
{
    const float4 sum = n->axis + other->axis;
    const float length = sqrt(dot3(sum, sum));
    const float4 axis = sum / length;
    const bool first = n->sine >= other->sine;
    const float sine = first ? n->sine : other->sine, cosine = first ? n->cosine : other->cosine;
    const float half_across = MAX(sine_between(axis, n->axis), sine_between(axis, other->axis));
    const float half_along = dot3(axis, n->axis);
    const bool wide = n->cosine <= 0.0f || other->cosine <= 0.0f || !(length > 0x1p-10f)
                      || half_along * cosine - half_across * sine <= SINE_SLACK;
    set_cone(n, axis, half_across * cosine + half_along * sine, wide);
}

// Equations 7 and 8.
inline void add_sphere(Node *n, const Node *other)
{
    const float4 offset = other->centre - n->centre;
    const float apart = 0.5f * sqrt(dot3(offset, offset));
    const float radius = (apart + MAX(n->radius, other->radius)) * RADIUS_SLACK;
    const bool bounded = radius < INFINITY; // as in hierarchy.cl
    n->centre = bounded ? n->centre + 0.5f * offset : (float4)0.0f;
    n->radius = bounded ? radius : INFINITY;
}

inline Node enclose(const Node *children, uint count)
{
    if (count == 0)
        return null_node();
    Node n = children[0];
    n.reach = INFINITY;
    for (uint k = 1; k < count; k++) {
        add_sphere(&n, children + k);
        if (n.cosine <= 0.0f)
            continue; // any direction already
        if (children[k].sine == 0.0f)
            add_ray(&n, children[k].axis);
        else
            add_cone(&n, children + k);
    }
    return n;
}
