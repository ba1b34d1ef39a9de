/* The control step in C, called from Python as the service's own is: a float in, a float out. Once as a method of a
 * module, which is the quickest way there is, and once as a plain function for ctypes.
 *
 * The same equations as twostage_servo/control/observer.py and laws/paper.py: the observer's update, both stages, the
 * change-over, the ramp, the limits of effort and of its rate. Left out is what those do not take part in: stopping.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>

static double a12, a22, b1, b2, gain1, gain2, gain3, memory;                      /* model and observer */
static double f11, f12, f22, changeover_time, ramp, effort_limit, largest_step;   /* law */
static double target, cruise_velocity, direction;                                 /* set-point */
static double position, velocity, disturbance, effort, sum, offset, reference;    /* state */
static int in_position_stage;

static void enter_position_stage(double wanted)
{
    offset = -position;
    sum = wanted + f12 * velocity;
    in_position_stage = 1;
    reference = 0.0;
}

static int speed_stage_ends(void)
{
    double distance = target - position;
    direction = copysign(1.0, distance);
    return 0.0 < direction * distance && direction * distance <= direction * reference * changeover_time;
}

static double limited(double wanted)
{
    if (!isfinite(wanted))
        return wanted;
    if (wanted > effort_limit)
        wanted = effort_limit;
    else if (wanted < -effort_limit)
        wanted = -effort_limit;
    double step = wanted - effort;
    return fabs(step) > largest_step ? effort + copysign(largest_step, step) : wanted;
}

double control_step(double sample)
{
    double innovation = sample - position, total = effort + disturbance, wanted;
    position = position + a12 * velocity + b1 * total + gain1 * innovation;
    velocity = a22 * velocity + b2 * total + gain2 * innovation;
    disturbance = memory * disturbance + gain3 * innovation;
    if (in_position_stage) {
        sum += f22 * (target - sample);
        wanted = sum - f12 * velocity - f11 * (position + offset);
    } else {
        wanted = sum - f12 * velocity;
        if (speed_stage_ends()) {
            enter_position_stage(wanted);
        } else {
            double goal = direction * cruise_velocity, change = goal - reference;
            reference = fabs(change) <= ramp ? goal : reference + copysign(ramp, change);
            sum += f22 * (reference - velocity);
        }
    }
    effort = limited(wanted);
    if (effort != wanted)
        sum += effort - wanted;
    return effort;
}

static PyObject *take_step(PyObject *module, PyObject *argument)
{
    double sample = argument == Py_None ? position : PyFloat_AsDouble(argument);
    if (sample == -1.0 && PyErr_Occurred())
        return NULL;
    return PyFloat_FromDouble(control_step(sample));
}

static PyObject *start(PyObject *module, PyObject *arguments)
{
    if (!PyArg_ParseTuple(
            arguments, "ddddddddddddddddd", &a12, &a22, &b1, &b2, &gain1, &gain2, &gain3, &memory, &f11, &f12, &f22,
            &changeover_time, &ramp, &effort_limit, &largest_step, &target, &cruise_velocity))
        return NULL;
    position = velocity = disturbance = effort = sum = offset = reference = 0.0;
    direction = copysign(1.0, target);
    in_position_stage = fabs(target) <= cruise_velocity * changeover_time;
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"step", take_step, METH_O, "Take y(k-1), or None; return u(k)."},
    {"start", start, METH_VARARGS, "Take model, gains, limits and a set-point; begin at rest at 0."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "control_step_in_c", NULL, -1, methods};

PyMODINIT_FUNC PyInit_control_step_in_c(void)
{
    return PyModule_Create(&definition);
}
