// The core in Unity, or any C# program: scenes, tissues and the motion of a needle over the C interface and nothing else.
//
// Put this file into Assets/ and the library (libechospline.so, libechospline.dylib, echospline.dll) into Assets/Plugins/. Structs and
// enums have the names of echospline.h; there are no defaults here. A Scene is shared by threads, a Tissue belongs to one at a time.
// `Tissue.Advance` and `Tissue.Displacement` allocate nothing: call them from FixedUpdate, or from a thread of your own.
using System;
using System.Runtime.InteropServices;

namespace Echospline
{
    public enum Status
    {
        Ok = 0, NullPointer = 1, WrongSize = 2, WrongValue = 3, OutOfMemory = 4, NotHeld = 5, NotSolved = 6, WrongState = 7,
        FailedHandle = 8, NeedsStation = 9
    }

    public enum Level { LevelBest = 0, LevelBaseline = 1, LevelAvx2 = 2, LevelAvx512 = 3, LevelNeon = 4, LevelSimd128 = 5 }

    public enum Kernel { ThinPlate = 0, Elastic = 1 }

    public enum Precision { Single = 0, Double = 1 }

    public enum Tip { TipPoint = 0, TipNode = 1 }

    public enum Loading { Follow = 0, Immediate = 1, Stick = 2 }

    public enum Plane { PlaneStress = 0, PlaneStrain = 1 }

    [Flags]
    public enum Edge : uint { Left = 1, Right = 2, Top = 4, Bottom = 8, Front = 16, Back = 32 }

    public enum LandmarkKind { Contact = 0, Leaving = 1, Tip = 2, TipLeft = 3 }

    public enum PixelType { Uint8 = 0, Uint16 = 1, Int16 = 2, Float32 = 3 }

    public enum Interpolation { Linear = 0, Nearest = 1 }

    public enum Border { BorderValue = 0, BorderTransparent = 1 }

    public enum Method { MethodAuto = 0, MethodExact = 1, MethodPull = 2 }

    public enum GreenMethod { GreenBoundary = 0, GreenSolve = 1 }

    public enum GreenCondition
    {
        ConditionClamped = 0, ConditionSlidingX = 1, ConditionSlidingY = 2, ConditionFree = 3, ConditionInterface = 4
    }

    [Flags]
    public enum NeedlePart : uint { Shaft = 1, Bevel = 2, Tail = 4, Shadow = 8 }

    /// <summary>Two numbers in mm: lateral, depth.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Point2
    {
        public double X, Y;

        public Point2(double x, double y) { X = x; Y = y; }
    }

    [StructLayout(LayoutKind.Sequential)]
    public struct Shape2
    {
        public int X, Y;

        public Shape2(int x, int y) { X = x; Y = y; }
    }

    /// <summary>Three numbers in mm: lateral, depth, elevation. In the plane the third is not read.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Point
    {
        public double X, Y, Z;

        public Point(double x, double y, double z = 0) { X = x; Y = y; Z = z; }
    }

    [StructLayout(LayoutKind.Sequential)]
    public struct Shape
    {
        public int X, Y, Z;

        public Shape(int x, int y, int z = 0) { X = x; Y = y; Z = z; }
    }

    /// <summary>echospline_scene_options; begin with SceneOptions.Defaults().</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct SceneOptions
    {
        public uint StructSize;
        public int Dimension;
        public Kernel Kernel;
        public Precision Precision;
        public Tip Tip;
        public Loading Loading;
        public Plane Plane;
        public Edge Clamped;
        public Level Level;
        public Shape Shape;
        public Point Spacing;
        public Point Origin;
        public double Sigma;
        public double Delta;
        public double Alpha1, Alpha2;
        public double Alpha3;
        public double Length;
        public double Drag;
        public double ContactSpacing;
        public double AnchorSpacing;
        public double Poisson;
        public double Radius;
        public IntPtr ClampedPoints;
        public long ClampedPointCount;
        public IntPtr Stiffness;
        public long StiffnessCount;
        public long ContactRoom;
        public Edge Sliding;
        public uint Reserved;
        public double FrictionSpeed;

        /// <summary>The core's own defaults; shape and spacing have to be set.</summary>
        public static SceneOptions Defaults()
        {
            var options = new SceneOptions { StructSize = (uint)Marshal.SizeOf(typeof(SceneOptions)) };
            Native.echospline_scene_defaults(ref options);
            return options;
        }
    }

    /// <summary>echospline_pose.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Pose
    {
        public Point Entry;
        public Point Tip;
        public double Speed;
        public double Dt;

        /// <summary>Move one step of dt seconds towards a command.</summary>
        public void Follow(ref Command command, double dt)
        {
            var next = new Pose { Dt = dt };
            var status = Native.echospline_follow(ref this, ref command, ref next);
            if (status != Status.Ok) throw new EchosplineException(status, Native.Text(Native.echospline_status_text(status)));
            this = next;
        }
    }

    /// <summary>echospline_command.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Command
    {
        public Point Entry;
        public Point Tip;
        public double Lag;
        public double Fastest;
    }

    /// <summary>echospline_landmark.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Landmark
    {
        public Point Place;
        public Point Displacement;
        public Point Grip;
        public double Along;
        public long Node;
        public LandmarkKind Kind;
        public int Reserved;
    }

    /// <summary>echospline_statistics.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Statistics
    {
        public uint StructSize;
        public int Reserved;
        public long Steps;
        public long Joined, Left;
        public long Rebuilt;
        public long HeldBack;
        public long Allocations;
        public double Residual;
    }

    /// <summary>echospline_picture_options.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct PictureOptions
    {
        public uint StructSize;
        public PixelType PixelType;
        public int Channels;
        public Interpolation Interpolation;
        public Border Border;
        public Method Method;
        public Level Level;
        public int Columns;
        public int Rows;
        public Shape2 MeshShape;
        public int Reserved;
        public Point2 Spacing;
        public Point2 Origin;
        public Point2 MeshSpacing;
        public Point2 MeshOrigin;
        public double BorderValue;
        public double White;

        /// <summary>The core's own defaults; sizes and spacings have to be set.</summary>
        public static PictureOptions Defaults()
        {
            var filled = new PictureOptions { StructSize = (uint)Marshal.SizeOf(typeof(PictureOptions)) };
            Native.echospline_picture_defaults(ref filled);
            return filled;
        }
    }

    /// <summary>echospline_needle.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Needle
    {
        public uint StructSize;
        public NeedlePart Parts;
        public uint Seed;
        public int Curved;
        public Point Entry;
        public Point Tip;
        public Point2 Apex;
        public double Diameter;
        public double Lateral;
        public double Axial;
        public double Elevation;
        public double ElevationDepth;
        public double ElementHeight;
        public double FNumber;
        public double DynamicRange;
        public double Specular;
        public double Lobe;
        public double LobeElevation;
        public double Steering;
        public double Roughness;
        public double Rolloff;
        public double Wobble;
        public double Patches;
        public double Bevel;
        public double RingDown;
        public double RingDownLoss;
        public double Opacity;

        /// <summary>The core's own defaults; entry and tip have to be set.</summary>
        public static Needle Defaults()
        {
            var filled = new Needle { StructSize = (uint)Marshal.SizeOf(typeof(Needle)) };
            Native.echospline_needle_defaults(ref filled);
            return filled;
        }
    }

    /// <summary>echospline_picture_report.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct PictureReport
    {
        public uint StructSize;
        public Method Method;
        public double Residual;
        public double Difference;
        public double ExactShare;
        public long FoldedCells;
        public double SmallestJacobian;
        public Point2 Place;
    }

    /// <summary>A call of the core that did not succeed, with the core's sentence.</summary>
    public sealed class EchosplineException : Exception
    {
        public readonly Status Status;

        public EchosplineException(Status status, string message) : base(message) { Status = status; }
    }

    /// <summary>What is given: mesh, clamped edges, parameters; factored once. Dispose of it after its tissues.</summary>
    public sealed class Scene : IDisposable
    {
        internal IntPtr Handle;
        public readonly int Dimension;

        public Scene(SceneOptions options)
        {
            Core.RequireVersion();
            Dimension = options.Dimension;
            var status = Native.echospline_scene_create(ref options, out Handle);
            if (status == Status.Ok) return;
            var message = Native.Text(Native.echospline_scene_message(Handle));
            Dispose();
            throw new EchosplineException(status, message);
        }

        public Level Level { get { return Native.echospline_scene_level(Handle); } }
        public long NodeCount { get { return Native.echospline_scene_node_count(Handle); } }

        /// <summary>Anchors, Dimension numbers each, mm.</summary>
        public double[] Anchors()
        {
            var anchors = new double[Native.echospline_scene_anchor_count(Handle) * Dimension];
            Check(Native.echospline_scene_anchors(Handle, anchors, anchors.LongLength));
            return anchors;
        }

        /// <summary>Mesh nodes that may become contacts, ascending.</summary>
        public long[] Sources()
        {
            var nodes = new long[Native.echospline_scene_source_count(Handle)];
            Check(Native.echospline_scene_sources(Handle, nodes, nodes.LongLength));
            return nodes;
        }

        public void Dispose()
        {
            Native.echospline_scene_destroy(Handle);
            Handle = IntPtr.Zero;
        }

        private void Check(Status status)
        {
            if (status != Status.Ok) throw new EchosplineException(status, Native.Text(Native.echospline_scene_message(Handle)));
        }
    }

    /// <summary>One needle's session in a scene.</summary>
    public sealed class Tissue : IDisposable
    {
        private readonly Scene scene;  // lives as long as its tissues
        private IntPtr handle;

        internal IntPtr Handle { get { return handle; } }

        public Tissue(Scene scene)
        {
            this.scene = scene;
            var status = Native.echospline_tissue_create(scene.Handle, out handle);
            if (status == Status.Ok) return;
            var message = Native.Text(Native.echospline_tissue_message(handle));
            Dispose();
            throw new EchosplineException(status, message);
        }

        /// <summary>Back to rest.</summary>
        public void Reset() { Check(Native.echospline_tissue_reset(handle)); }

        /// <summary>Advance by one step.</summary>
        public void Advance(ref Pose pose) { Check(Native.echospline_advance(handle, ref pose)); }

        /// <summary>Write the displacement of the mesh nodes, Dimension numbers each, mm.</summary>
        public void Displacement(double[] field) { Check(Native.echospline_displacement(handle, field, field.LongLength)); }

        /// <summary>The same in single precision.</summary>
        public void Displacement(float[] field) { Check(Native.echospline_displacement_single(handle, field, field.LongLength)); }

        /// <summary>Write the displacement of reference points, Dimension numbers each, mm.</summary>
        public void DisplacementAt(double[] points, double[] displacement)
        {
            if (displacement.Length != points.Length)
                throw new ArgumentException("expected room for " + points.Length + " numbers; got " + displacement.Length);
            Check(Native.echospline_displacement_at(handle, points, points.LongLength / scene.Dimension, displacement));
        }

        /// <summary>Landmarks that move.</summary>
        public Landmark[] Landmarks()
        {
            long count;
            Check(Native.echospline_landmarks(handle, null, 0, out count));
            var landmarks = new Landmark[count];
            Check(Native.echospline_landmarks(handle, landmarks, count, out count));
            return landmarks;
        }

        /// <summary>Counts since the tissue was created.</summary>
        public Statistics Statistics()
        {
            var statistics = new Statistics { StructSize = (uint)Marshal.SizeOf(typeof(Statistics)) };
            Check(Native.echospline_tissue_statistics(handle, ref statistics));
            return statistics;
        }

        /// <summary>The present state as bytes.</summary>
        public byte[] Save()
        {
            var bytes = new byte[Native.echospline_state_size(handle)];
            Check(Native.echospline_state_save(handle, bytes, bytes.LongLength));
            return bytes;
        }

        /// <summary>Make saved bytes the present state.</summary>
        public void Load(byte[] bytes) { Check(Native.echospline_state_load(handle, bytes, bytes.LongLength)); }

        public void Dispose()
        {
            Native.echospline_tissue_destroy(handle);
            handle = IntPtr.Zero;
        }

        private void Check(Status status)
        {
            if (status != Status.Ok) throw new EchosplineException(status, Native.Text(Native.echospline_tissue_message(handle)));
        }
    }

    /// <summary>echospline_look: how a grey picture is shown; begin with Look.Defaults(). Look.Shade makes its RGBA.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Look
    {
        public uint StructSize;
        public Level Level;
        public int Invert, Flip;
        public double Gain, RecordedRange, DynamicRange;  // dB
        public int DepthGainCount;
        public int Reserved;
        [MarshalAs(UnmanagedType.ByValArray, SizeConst = 8)] public double[] DepthGains;  // dB

        /// <summary>The core's own defaults: a picture of 60 dB as it is.</summary>
        public static Look Defaults()
        {
            var look = new Look { StructSize = (uint)Marshal.SizeOf(typeof(Look)), DepthGains = new double[8] };
            Native.echospline_look_defaults(ref look);
            return look;
        }

        /// <summary>Shade grey pixels (rows, columns) into red, green, blue and alpha.</summary>
        public void Shade(byte[] grey, int columns, int rows, byte[] rgba)
        {
            if (grey.LongLength != (long)columns * rows)
                throw new ArgumentException("expected " + (long)columns * rows + " grey pixels; got " + grey.LongLength);
            var status = Native.echospline_shade(ref this, grey, columns, rows, rgba, rgba.LongLength);
            if (status != Status.Ok) throw new EchosplineException(status, Native.Text(Native.echospline_status_text(status)));
        }
    }

    /// <summary>echospline_forced_options; begin with ForcedOptions.Defaults().</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct ForcedOptions
    {
        public uint StructSize;
        public Level Level;
        public long NodeCount;
        public Point2 Low, High;
        public double Tip;
        public double FrictionLimit;
        public double Bond;
        public double TipStiffness;
        public double SideStiffness;
        public double Viscosity;
        public double StationSpacing;
        public double Substep;
        public double DeadBand;

        /// <summary>The core's own defaults; node count and corners have to be set.</summary>
        public static ForcedOptions Defaults()
        {
            var options = new ForcedOptions { StructSize = (uint)Marshal.SizeOf(typeof(ForcedOptions)) };
            Native.echospline_forced_defaults(ref options);
            return options;
        }
    }

    /// <summary>echospline_station: where a station's force acts.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Station
    {
        public long Index;
        public Point2 Place;
        public Point2 Axis;
        public Point2 First, Second, Third, Fourth;  // points
        public double WeightOfFirst, WeightOfSecond, WeightOfThird, WeightOfFourth;
        public int PointCount;
        public int Reserved;
    }

    /// <summary>echospline_needle_load: the needle's forces, N and N mm, and the track cut so far, mm.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct NeedleLoad
    {
        public double Tip, Friction, Side, Torque, Cut;
    }

    /// <summary>Tissue in the plane under a needle that sticks, slips and cuts; how it answers forces comes from outside.</summary>
    public sealed class Forced : IDisposable
    {
        /// <summary>Displacement of the nodes by a unit force along x, then y (2, nodes, 2), and over the stations (index + 1, 2, 2), mm/N.</summary>
        public delegate void Answer(ref Station wanted, Station[] before, out float[] columns, out double[] rows);

        private readonly Answer answer;
        private IntPtr handle;

        public Forced(ForcedOptions options, Answer answer)
        {
            Core.RequireVersion();
            this.answer = answer;
            var status = Native.echospline_forced_create(ref options, out handle);
            if (status == Status.Ok) return;
            var message = Native.Text(Native.echospline_forced_message(handle));
            Dispose();
            throw new EchosplineException(status, message);
        }

        /// <summary>Tissue that a green of its mesh and level answers, in the core; the green is disposed after it.</summary>
        public Forced(ForcedOptions options, Green green) : this(options, (Answer)null)
        {
            var status = Native.echospline_forced_attach(handle, green.Handle);
            if (status == Status.Ok) return;
            var message = Native.Text(Native.echospline_forced_message(handle));
            Dispose();
            throw new EchosplineException(status, message);
        }

        /// <summary>Displacement of reference points in the tissue, two numbers each, mm; needs a green.</summary>
        public void DisplacementAt(double[] points, double[] displacement)
        {
            if (displacement.Length < points.Length)
                throw new ArgumentException("expected room for " + points.Length + " numbers; got " + displacement.Length);
            Check(Native.echospline_forced_displacement_at(handle, points, points.LongLength / 2, displacement));
        }

        /// <summary>Back to rest.</summary>
        public void Reset() { Check(Native.echospline_forced_reset(handle)); }

        /// <summary>Advance by one step.</summary>
        public void Advance(ref Pose pose)
        {
            Status status;
            while ((status = Native.echospline_forced_advance(handle, ref pose)) == Status.NeedsStation) Supply();
            Check(status);
        }

        /// <summary>The needle's forces: what a haptic device needs.</summary>
        public NeedleLoad Load()
        {
            NeedleLoad load;
            Check(Native.echospline_forced_load(handle, out load));
            return load;
        }

        /// <summary>Force at every station, two numbers each, N.</summary>
        public double[] Forces()
        {
            long count;
            Check(Native.echospline_forced_forces(handle, null, 0, out count));
            var forces = new double[2 * count];
            Check(Native.echospline_forced_forces(handle, forces, count, out count));
            return forces;
        }

        /// <summary>Stations that have been answered.</summary>
        public Station[] Stations()
        {
            long count;
            Check(Native.echospline_forced_stations(handle, null, 0, out count));
            var stations = new Station[count];
            Check(Native.echospline_forced_stations(handle, stations, count, out count));
            return stations;
        }

        /// <summary>Write the displacement of the mesh nodes, two numbers each, mm.</summary>
        public void Displacement(double[] field)
        {
            Status status;
            while ((status = Native.echospline_forced_displacement(handle, field, field.LongLength)) == Status.NeedsStation) Supply();
            Check(status);
        }

        /// <summary>The same in single precision.</summary>
        public void Displacement(float[] field)
        {
            Status status;
            while ((status = Native.echospline_forced_displacement_single(handle, field, field.LongLength)) == Status.NeedsStation) Supply();
            Check(status);
        }

        /// <summary>The present state as bytes.</summary>
        public byte[] Save()
        {
            var bytes = new byte[Native.echospline_forced_state_size(handle)];
            Check(Native.echospline_forced_state_save(handle, bytes, bytes.LongLength));
            return bytes;
        }

        /// <summary>Make saved bytes the present state.</summary>
        public void Restore(byte[] bytes) { Check(Native.echospline_forced_state_load(handle, bytes, bytes.LongLength)); }

        public void Dispose()
        {
            Native.echospline_forced_destroy(handle);
            handle = IntPtr.Zero;
        }

        private void Supply()
        {
            Station wanted;
            Check(Native.echospline_forced_wanted(handle, out wanted));
            var before = Stations();
            Array.Resize(ref before, (int)wanted.Index);
            float[] columns;
            double[] rows;
            answer(ref wanted, before, out columns, out rows);
            Check(Native.echospline_forced_answer(handle, columns, columns.LongLength, rows, rows.LongLength));
        }

        private void Check(Status status)
        {
            if (status != Status.Ok) throw new EchosplineException(status, Native.Text(Native.echospline_forced_message(handle)));
        }
    }

    /// <summary>echospline_green_options; begin with GreenOptions.Defaults(). Arrays are those of GreenTables.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct GreenOptions
    {
        public uint StructSize;
        public Level Level;
        public GreenMethod Method;
        public Edge Clamped, Sliding;
        public Shape2 Shape;
        public int Reserved;
        public Point2 Spacing, Origin;
        public double Radius;
        public double Weight;
        public double PinWeight;
        public double PinRadius;
        public double Lattice;
        public IntPtr Bodies, Depths, Circles, Sources, SourceCounts, Conditions, Sides, Pins, Order, Right, Left;
        public long BodyCount, BandCount, SourceCount, ConditionCount, PinCount, Rank;
        public IntPtr LinesX, LinesY, Moduli, Held;
        public long LineXCount, LineYCount, TriangleCount, HeldCount;

        /// <summary>The core's own defaults; mesh, radius and what the method needs have to be set.</summary>
        public static GreenOptions Defaults()
        {
            var options = new GreenOptions { StructSize = (uint)Marshal.SizeOf(typeof(GreenOptions)) };
            Native.echospline_green_defaults(ref options);
            return options;
        }
    }

    /// <summary>Tables of echospline_green_options, flat, named as there; those of the other method stay null.</summary>
    public sealed class GreenTables
    {
        public double[] Bodies, Depths, Circles, Sources, Conditions, Pins, LinesX, LinesY, Moduli;
        public int[] SourceCounts, Sides, Order;
        public byte[] Held;
    }

    /// <summary>How tissue in the plane answers forces, by Green's function. Threads may share it if no call of theirs fails.</summary>
    public sealed class Green : IDisposable
    {
        private IntPtr handle;

        /// <summary>Counts of the options but BandCount follow from the tables.</summary>
        public Green(GreenOptions options, GreenTables tables)
        {
            Core.RequireVersion();
            options.BodyCount = Entries(tables.Bodies, 2, "Bodies");
            options.SourceCount = Entries(tables.Sources, 2, "Sources");
            options.ConditionCount = Entries(tables.Conditions, 4, "Conditions");
            options.PinCount = Entries(tables.Pins, 2, "Pins");
            options.Rank = Entries(tables.Order, 1, "Order");
            options.LineXCount = Entries(tables.LinesX, 1, "LinesX");
            options.LineYCount = Entries(tables.LinesY, 1, "LinesY");
            options.TriangleCount = Entries(tables.Moduli, 2, "Moduli");
            options.HeldCount = Entries(tables.Held, 1, "Held");
            if (options.Method == GreenMethod.GreenBoundary)
            {
                Require(tables.Depths, options.BandCount + 1, "Depths");
                Require(tables.Circles, 3 * (options.BodyCount - options.BandCount), "Circles");
                Require(tables.SourceCounts, options.BodyCount, "SourceCounts");
                Require(tables.Sides, 3 * options.ConditionCount, "Sides");
            }
            options.Right = options.Left = IntPtr.Zero;
            var arrays = new Array[]
            {
                tables.Bodies, tables.Depths, tables.Circles, tables.Sources, tables.SourceCounts, tables.Conditions, tables.Sides,
                tables.Pins, tables.Order, tables.LinesX, tables.LinesY, tables.Moduli, tables.Held
            };
            var pinned = new GCHandle[arrays.Length];
            var at = new IntPtr[arrays.Length];
            try
            {
                for (int i = 0; i < arrays.Length; ++i)
                {
                    if (arrays[i] == null) continue;
                    pinned[i] = GCHandle.Alloc(arrays[i], GCHandleType.Pinned);
                    at[i] = pinned[i].AddrOfPinnedObject();
                }
                options.Bodies = at[0]; options.Depths = at[1]; options.Circles = at[2]; options.Sources = at[3];
                options.SourceCounts = at[4]; options.Conditions = at[5]; options.Sides = at[6]; options.Pins = at[7];
                options.Order = at[8]; options.LinesX = at[9]; options.LinesY = at[10]; options.Moduli = at[11]; options.Held = at[12];
                var status = Native.echospline_green_create(ref options, out handle);
                if (status == Status.Ok) return;
                var message = Native.Text(Native.echospline_green_message(handle));
                Dispose();
                throw new EchosplineException(status, message);
            }
            finally
            {
                foreach (var pin in pinned) if (pin.IsAllocated) pin.Free();
            }
        }

        internal IntPtr Handle { get { return handle; } }

        /// <summary>Displacement (count, 2, cases) mm of nodes and of points under forces (places, 2, cases) N; mesh or at may be null.</summary>
        public void Answer(double[] places, double[] forces, int cases, double[] points, double[] mesh, double[] at)
        {
            if (forces.LongLength != places.LongLength * cases)
                throw new ArgumentException("expected " + places.LongLength * cases + " numbers of forces; got " + forces.LongLength);
            var status = Native.echospline_green_answer(handle, places, places.LongLength / 2, forces, cases, points,
                points == null ? 0 : points.LongLength / 2, mesh, mesh == null ? 0 : mesh.LongLength, at, at == null ? 0 : at.LongLength);
            if (status != Status.Ok) throw new EchosplineException(status, Native.Text(Native.echospline_green_message(handle)));
        }

        public void Dispose()
        {
            Native.echospline_green_destroy(handle);
            handle = IntPtr.Zero;
        }

        private static long Entries(Array table, int width, string name)
        {
            long numbers = table == null ? 0 : table.LongLength;
            if (numbers % width != 0) throw new ArgumentException("expected " + width + " numbers per entry of " + name + "; got " + numbers);
            return numbers / width;
        }

        private static void Require(Array table, long count, string name)
        {
            long numbers = table == null ? 0 : table.LongLength;
            if (numbers != count) throw new ArgumentException("expected " + count + " numbers of " + name + "; got " + numbers);
        }
    }

    /// <summary>A reference image, its deformation and a needle's echo. Pixels are (rows, columns, channels).</summary>
    public sealed class Picture : IDisposable
    {
        private IntPtr handle;

        public Picture(PictureOptions options, Array pixels)
        {
            Core.RequireVersion();
            var pinned = GCHandle.Alloc(pixels, GCHandleType.Pinned);
            try
            {
                var expected = (long)options.Columns * options.Rows * options.Channels;
                if (pixels.LongLength != expected)
                    throw new ArgumentException("expected " + expected + " pixels (rows, columns, channels); got " + pixels.LongLength);
                var status = Native.echospline_picture_create(ref options, pinned.AddrOfPinnedObject(), out handle);
                if (status == Status.Ok) return;
                var message = Native.Text(Native.echospline_picture_message(handle));
                Dispose();
                throw new EchosplineException(status, message);
            }
            finally
            {
                pinned.Free();
            }
        }

        public Level Level { get { return Native.echospline_picture_level(handle); } }

        /// <summary>Bytes that a drawn picture takes.</summary>
        public long Size { get { return Native.echospline_picture_size(handle); } }

        /// <summary>Replace the reference by pixels of the same layout.</summary>
        public void Reference(Array pixels)
        {
            var pinned = GCHandle.Alloc(pixels, GCHandleType.Pinned);
            try { Check(Native.echospline_picture_reference(handle, pinned.AddrOfPinnedObject(), Buffer.ByteLength(pixels))); }
            finally { pinned.Free(); }
        }

        /// <summary>Deform by the displacement of the mesh nodes, two numbers each, mm.</summary>
        public void Deform(double[] field) { Check(Native.echospline_picture_deform(handle, field, field.LongLength)); }

        /// <summary>The same in single precision.</summary>
        public void Deform(float[] field) { Check(Native.echospline_picture_deform_single(handle, field, field.LongLength)); }

        /// <summary>Deform as a tissue in the plane is now, straight from its field; the mesh has to be the tissue's.</summary>
        public void Follow(Tissue tissue) { Check(Native.echospline_picture_follow(handle, tissue.Handle)); }

        /// <summary>Draw into bytes, without a needle.</summary>
        public void Draw(byte[] bytes) { Check(Native.echospline_picture_draw(handle, IntPtr.Zero, bytes, bytes.LongLength)); }

        /// <summary>Draw into bytes, with a needle.</summary>
        public void Draw(ref Needle needle, byte[] bytes)
        {
            Check(Native.echospline_picture_draw(handle, ref needle, bytes, bytes.LongLength));
        }

        /// <summary>Column and row of the reference that each pixel comes from; NaN where no tissue is.</summary>
        public void Inverse(float[] x, float[] y)
        {
            if (y.Length != x.Length) throw new ArgumentException("expected x and y of one length; got " + x.Length + " and " + y.Length);
            Check(Native.echospline_picture_inverse(handle, x, y, x.LongLength));
        }

        /// <summary>Check the inverse against the forward map, and find folds.</summary>
        public PictureReport Report()
        {
            var report = new PictureReport { StructSize = (uint)Marshal.SizeOf(typeof(PictureReport)) };
            Check(Native.echospline_picture_check(handle, ref report));
            return report;
        }

        /// <summary>Echo at points, two numbers each, mm: power relative to white, share of the tissue's power that passes.</summary>
        public void Echo(ref Needle needle, double[] points, double[] power, double[] transmission)
        {
            if (2 * power.Length != points.Length || 2 * transmission.Length != points.Length)
                throw new ArgumentException("expected room for " + points.Length / 2 + " points; got " + power.Length + " and " + transmission.Length);
            Check(Native.echospline_picture_echo(handle, ref needle, points, power.LongLength, power, transmission));
        }

        public void Dispose()
        {
            Native.echospline_picture_destroy(handle);
            handle = IntPtr.Zero;
        }

        private void Check(Status status)
        {
            if (status != Status.Ok) throw new EchosplineException(status, Native.Text(Native.echospline_picture_message(handle)));
        }
    }

    /// <summary>The library: its version and processor level.</summary>
    public static class Core
    {
        public const uint Version = 0 << 16 | 1 << 8 | 0;  // of the header that this file was written for

        public static Level Best { get { return Native.echospline_level_best(); } }

        public static bool Available(Level level) { return Native.echospline_level_available(level) != 0; }

        public static string Name(Level level) { return Native.Text(Native.echospline_level_name(level)); }

        public static void RequireVersion()
        {
            var version = Native.echospline_version();
            if (version != Version)
                throw new InvalidOperationException("expected version " + Text(Version) + " of the echospline library; got "
                    + Text(version) + "; put the library that belongs to Echospline.cs into Plugins/");
        }

        private static string Text(uint version) { return (version >> 16) + "." + (version >> 8 & 255) + "." + (version & 255); }
    }

    internal static class Native
    {
        private const string Library = "echospline";

        internal static string Text(IntPtr text) { return Marshal.PtrToStringAnsi(text); }

        [DllImport(Library)] internal static extern IntPtr echospline_status_text(Status status);
        [DllImport(Library)] internal static extern uint echospline_version();
        [DllImport(Library)] internal static extern Level echospline_level_best();
        [DllImport(Library)] internal static extern int echospline_level_available(Level level);
        [DllImport(Library)] internal static extern IntPtr echospline_level_name(Level level);
        [DllImport(Library)] internal static extern void echospline_scene_defaults(ref SceneOptions options);
        [DllImport(Library)] internal static extern Status echospline_scene_create(ref SceneOptions options, out IntPtr scene);
        [DllImport(Library)] internal static extern void echospline_scene_destroy(IntPtr scene);
        [DllImport(Library)] internal static extern IntPtr echospline_scene_message(IntPtr scene);
        [DllImport(Library)] internal static extern Level echospline_scene_level(IntPtr scene);
        [DllImport(Library)] internal static extern long echospline_scene_node_count(IntPtr scene);
        [DllImport(Library)] internal static extern long echospline_scene_anchor_count(IntPtr scene);
        [DllImport(Library)] internal static extern long echospline_scene_source_count(IntPtr scene);
        [DllImport(Library)] internal static extern Status echospline_scene_anchors(IntPtr scene, double[] anchors, long count);
        [DllImport(Library)] internal static extern Status echospline_scene_sources(IntPtr scene, long[] nodes, long count);
        [DllImport(Library)] internal static extern Status echospline_follow(ref Pose now, ref Command command, ref Pose next);
        [DllImport(Library)] internal static extern Status echospline_tissue_create(IntPtr scene, out IntPtr tissue);
        [DllImport(Library)] internal static extern void echospline_tissue_destroy(IntPtr tissue);
        [DllImport(Library)] internal static extern IntPtr echospline_tissue_message(IntPtr tissue);
        [DllImport(Library)] internal static extern Status echospline_tissue_reset(IntPtr tissue);
        [DllImport(Library)] internal static extern Status echospline_advance(IntPtr tissue, ref Pose pose);
        [DllImport(Library)] internal static extern Status echospline_displacement(IntPtr tissue, double[] displacement, long count);
        [DllImport(Library)] internal static extern Status echospline_displacement_single(IntPtr tissue, float[] displacement, long count);
        [DllImport(Library)] internal static extern Status echospline_displacement_at(IntPtr tissue, double[] points, long point_count, [Out] double[] displacement);
        [DllImport(Library)] internal static extern Status echospline_landmarks(IntPtr tissue, [Out] Landmark[] landmarks, long room, out long count);
        [DllImport(Library)] internal static extern Status echospline_tissue_statistics(IntPtr tissue, ref Statistics statistics);
        [DllImport(Library)] internal static extern long echospline_state_size(IntPtr tissue);
        [DllImport(Library)] internal static extern Status echospline_state_save(IntPtr tissue, [Out] byte[] bytes, long size);
        [DllImport(Library)] internal static extern Status echospline_state_load(IntPtr tissue, byte[] bytes, long size);
        [DllImport(Library)] internal static extern void echospline_picture_defaults(ref PictureOptions options);
        [DllImport(Library)] internal static extern void echospline_needle_defaults(ref Needle needle);
        [DllImport(Library)] internal static extern Status echospline_picture_create(ref PictureOptions options, IntPtr pixels, out IntPtr picture);
        [DllImport(Library)] internal static extern void echospline_picture_destroy(IntPtr picture);
        [DllImport(Library)] internal static extern IntPtr echospline_picture_message(IntPtr picture);
        [DllImport(Library)] internal static extern Level echospline_picture_level(IntPtr picture);
        [DllImport(Library)] internal static extern long echospline_picture_size(IntPtr picture);
        [DllImport(Library)] internal static extern Status echospline_picture_reference(IntPtr picture, IntPtr pixels, long bytes);
        [DllImport(Library)] internal static extern Status echospline_picture_deform(IntPtr picture, double[] displacement, long count);
        [DllImport(Library)] internal static extern Status echospline_picture_deform_single(IntPtr picture, float[] displacement, long count);
        [DllImport(Library)] internal static extern Status echospline_picture_follow(IntPtr picture, IntPtr tissue);
        [DllImport(Library)] internal static extern Status echospline_picture_draw(IntPtr picture, IntPtr needle, [Out] byte[] bytes, long size);
        [DllImport(Library)] internal static extern Status echospline_picture_draw(IntPtr picture, ref Needle needle, [Out] byte[] bytes, long size);
        [DllImport(Library)] internal static extern Status echospline_picture_inverse(IntPtr picture, [Out] float[] x, [Out] float[] y, long count);
        [DllImport(Library)] internal static extern Status echospline_picture_check(IntPtr picture, ref PictureReport report);
        [DllImport(Library)] internal static extern Status echospline_picture_echo(IntPtr picture, ref Needle needle, double[] points, long point_count, [Out] double[] power, [Out] double[] transmission);
        [DllImport(Library)] internal static extern void echospline_look_defaults(ref Look look);
        [DllImport(Library)] internal static extern Status echospline_shade(ref Look look, byte[] grey, int columns, int rows, [Out] byte[] rgba, long bytes);
        [DllImport(Library)] internal static extern void echospline_forced_defaults(ref ForcedOptions options);
        [DllImport(Library)] internal static extern Status echospline_forced_create(ref ForcedOptions options, out IntPtr forced);
        [DllImport(Library)] internal static extern void echospline_forced_destroy(IntPtr forced);
        [DllImport(Library)] internal static extern IntPtr echospline_forced_message(IntPtr forced);
        [DllImport(Library)] internal static extern Status echospline_forced_reset(IntPtr forced);
        [DllImport(Library)] internal static extern Status echospline_forced_advance(IntPtr forced, ref Pose pose);
        [DllImport(Library)] internal static extern Status echospline_forced_wanted(IntPtr forced, out Station station);
        [DllImport(Library)] internal static extern Status echospline_forced_stations(IntPtr forced, [Out] Station[] stations, long room, out long count);
        [DllImport(Library)] internal static extern Status echospline_forced_answer(IntPtr forced, float[] columns, long count, double[] rows, long row_count);
        [DllImport(Library)] internal static extern Status echospline_forced_load(IntPtr forced, out NeedleLoad load);
        [DllImport(Library)] internal static extern Status echospline_forced_forces(IntPtr forced, [Out] double[] forces, long room, out long count);
        [DllImport(Library)] internal static extern Status echospline_forced_displacement(IntPtr forced, [Out] double[] displacement, long count);
        [DllImport(Library)] internal static extern Status echospline_forced_displacement_single(IntPtr forced, [Out] float[] displacement, long count);
        [DllImport(Library)] internal static extern long echospline_forced_state_size(IntPtr forced);
        [DllImport(Library)] internal static extern Status echospline_forced_state_save(IntPtr forced, [Out] byte[] bytes, long size);
        [DllImport(Library)] internal static extern Status echospline_forced_state_load(IntPtr forced, byte[] bytes, long size);
        [DllImport(Library)] internal static extern void echospline_green_defaults(ref GreenOptions options);
        [DllImport(Library)] internal static extern Status echospline_green_create(ref GreenOptions options, out IntPtr green);
        [DllImport(Library)] internal static extern void echospline_green_destroy(IntPtr green);
        [DllImport(Library)] internal static extern IntPtr echospline_green_message(IntPtr green);
        [DllImport(Library)] internal static extern Status echospline_green_answer(IntPtr green, double[] places, long place_count, double[] forces, long case_count, double[] points, long point_count, [Out] double[] mesh, long mesh_count, [Out] double[] at, long at_count);
        [DllImport(Library)] internal static extern Status echospline_forced_attach(IntPtr forced, IntPtr green);
        [DllImport(Library)] internal static extern Status echospline_forced_displacement_at(IntPtr forced, double[] points, long point_count, [Out] double[] displacement);
    }
}
