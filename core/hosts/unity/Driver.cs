// Uses Echospline.cs as a Unity script would, without Unity: a push, a stop, a saved state, an error.
//
//     mcs -out:driver.exe Driver.cs Echospline.cs && LD_LIBRARY_PATH=<folder of the library> mono driver.exe
using System;
using Echospline;

public static class Driver
{
    public static int Main()
    {
        var options = SceneOptions.Defaults();
        options.Shape = new Shape(40, 30);
        options.Spacing = new Point(40.0 / 39, 30.0 / 29);
        using (var scene = new Scene(options))
        using (var tissue = new Tissue(scene))
        using (var other = new Tissue(scene))
        {
            var field = new float[2 * scene.NodeCount];
            var again = new float[2 * scene.NodeCount];
            var pose = new Pose { Entry = new Point(8, 0), Tip = new Point(9, 1) };
            var command = new Command { Entry = new Point(8, 0), Tip = new Point(26, 18), Lag = 0.08, Fastest = 20 };
            for (int step = 0; step < 120; ++step)
            {
                pose.Follow(ref command, 0.02);  // FixedUpdate's default
                tissue.Advance(ref pose);
                tissue.Displacement(field);
            }
            Require(Math.Abs(pose.Tip.X - 26) < 0.5, "the tip arrives");
            float largest = 0;
            foreach (var u in field) largest = Math.Max(largest, Math.Abs(u));
            Require(largest > 0.1 && largest < 20, "the tissue moves");

            other.Load(tissue.Save());
            other.Displacement(again);
            for (int i = 0; i < field.Length; ++i) Require(Math.Abs(field[i] - again[i]) < 1e-5, "a saved state comes back");
            Require(tissue.Landmarks().Length > 0, "landmarks are listed");
            Require(scene.Anchors().Length > 0 && scene.Sources().Length > 0, "anchors and sources are listed");
            var at = new double[2];
            tissue.DisplacementAt(new double[] { pose.Tip.X, pose.Tip.Y }, at);
            var statistics = tissue.Statistics();
            Require(statistics.Steps == 120, "steps are counted");
            Require(statistics.Allocations == 0, "the loop allocates nothing");

            try
            {
                tissue.Displacement(new float[3]);
                Require(false, "a wrong size is refused");
            }
            catch (EchosplineException error)
            {
                Require(error.Status == Status.WrongSize && error.Message.Length > 0, "a wrong size is refused");
            }
            DrawPicture(tissue, field, pose);
            PushForced(pose);
            tissue.Reset();
            tissue.Displacement(field);
            foreach (var u in field) Require(u == 0, "rest is rest");
            Console.WriteLine("level {0}, {1} nodes, tip ({2:0.00}, {3:0.00}), displacement {4:0.000} mm at most, {5:0.000} mm at the tip",
                Core.Name(scene.Level), scene.NodeCount, pose.Tip.X, pose.Tip.Y, largest, Math.Sqrt(at[0] * at[0] + at[1] * at[1]));
        }
        return 0;
    }

    private static void DrawPicture(Tissue tissue, float[] field, Pose pose)
    {
        var options = PictureOptions.Defaults();
        options.Columns = 200;
        options.Rows = 150;
        options.Spacing = new Point2(0.2, 0.2);
        options.MeshShape = new Shape2(40, 30);
        options.MeshSpacing = new Point2(40.0 / 39, 30.0 / 29);
        var pixels = new byte[options.Columns * options.Rows];
        for (int i = 0; i < pixels.Length; ++i) pixels[i] = (byte)(i % 200);
        using (var picture = new Picture(options, pixels))
        {
            var still = new byte[picture.Size];
            var drawn = new byte[picture.Size];
            picture.Draw(still);
            picture.Deform(field);
            var needle = Needle.Defaults();
            needle.Entry = pose.Entry;
            needle.Tip = pose.Tip;
            picture.Draw(ref needle, drawn);
            int changed = 0;
            for (int i = 0; i < drawn.Length; ++i) changed += drawn[i] != still[i] ? 1 : 0;
            Require(changed > drawn.Length / 10, "the picture deforms");
            Require(picture.Report().Residual < 0.1, "the inverse is good to a tenth of a pixel");

            picture.Deform(new float[field.Length]);
            picture.Follow(tissue);
            var followed = new byte[picture.Size];
            picture.Draw(ref needle, followed);
            for (int i = 0; i < drawn.Length; ++i) Require(Math.Abs(drawn[i] - followed[i]) <= 1, "a picture follows its tissue");
        }
    }

    private static void PushForced(Pose pose)
    {
        var options = GreenOptions.Defaults();
        options.Method = GreenMethod.GreenSolve;
        options.Sliding = Edge.Top;
        options.Clamped = Edge.Left | Edge.Right | Edge.Bottom;
        options.Shape = new Shape2(41, 31);
        options.Spacing = new Point2(1, 1);
        options.Radius = 0.4;
        const int Across = 8, Down = 6;
        var tables = new GreenTables
        {
            LinesX = new double[Across + 1], LinesY = new double[Down + 1], Moduli = new double[4 * Across * Down],
            Held = new byte[2 * (2 * Across + 1) * (2 * Down + 1)]
        };
        for (int i = 0; i <= Across; ++i) tables.LinesX[i] = 40.0 * i / Across;
        for (int i = 0; i <= Down; ++i) tables.LinesY[i] = 30.0 * i / Down;
        for (int i = 0; i < tables.Moduli.Length; ++i) tables.Moduli[i] = 0.03;  // N/mm: both of Lame's moduli
        for (int j = 0; j <= 2 * Down; ++j)
            for (int i = 0; i <= 2 * Across; ++i)
            {
                bool clamped = i == 0 || i == 2 * Across || j == 2 * Down;
                tables.Held[2 * (j * (2 * Across + 1) + i)] = (byte)(clamped ? 1 : 0);
                tables.Held[2 * (j * (2 * Across + 1) + i) + 1] = (byte)(clamped || j == 0 ? 1 : 0);
            }
        var law = ForcedOptions.Defaults();
        law.NodeCount = 41 * 31;
        law.High = new Point2(40, 30);
        using (var green = new Green(options, tables))
        using (var tissue = new Forced(law, green))
        using (var other = new Forced(law, green))
        {
            pose = new Pose { Entry = new Point(20, 0), Tip = new Point(20, 0), Dt = 0.02 };
            for (int step = 0; step < 60; ++step)
            {
                pose.Tip = new Point(20, 0.25 * step);
                tissue.Advance(ref pose);
            }
            Require(tissue.Load().Tip > 0 && tissue.Stations().Length > 5, "the green answers every station");
            var field = new double[2 * 41 * 31];
            var at = new double[2];
            tissue.Displacement(field);
            tissue.DisplacementAt(new double[] { 20, 12 }, at);
            Require(Math.Abs(field[2 * (12 * 41 + 20) + 1] - at[1]) < 1e-5 && at[1] > 0.05, "a node moves as its place does");
            other.Restore(tissue.Save());
            var again = new double[field.Length];
            other.Displacement(again);
            for (int i = 0; i < field.Length; ++i) Require(field[i] == again[i], "a saved state comes back");
            green.Answer(new double[] { 20, 12 }, new double[] { 0, 0.1 }, 1, null, field, null);
            Require(field[2 * (12 * 41 + 20) + 1] > 0, "tissue moves with a force");
        }
    }

    private static void Require(bool right, string what)
    {
        if (!right) throw new Exception("expected: " + what);
    }
}
